# fish completion for gpebo; in ~/.config/fish/config.fish:  gpebo completion fish | source
function __gpebo
    set -l words (commandline -opc) (commandline -ct)
    $words[1] __complete $words[2..-1] 2>/dev/null
end
complete -c gpebo -f -a '(__gpebo)'
