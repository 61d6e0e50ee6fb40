#compdef gpebo
# zsh completion for gpebo; in ~/.zshrc, after compinit:  eval "$(gpebo completion zsh)"
_gpebo() {
    local -a plain open shown_plain shown_open
    local reply text
    while IFS=$'\t' read -r reply text; do
        if [[ $reply == *(=|.|/|\[) ]]; then
            open+=("$reply"); shown_open+=("$reply${text:+  -- $text}")
        else
            plain+=("$reply"); shown_plain+=("$reply${text:+  -- $text}")
        fi
    done < <("${words[1]}" __complete "${(@Q)words[2,CURRENT]}" 2>/dev/null)
    (( $#plain )) && compadd -l -d shown_plain -a plain
    (( $#open )) && compadd -S '' -l -d shown_open -a open
}
compdef _gpebo gpebo
