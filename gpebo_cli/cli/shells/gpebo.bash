# bash completion for gpebo; in ~/.bashrc:  eval "$(gpebo completion bash)"
# It cuts words at "=" (COMP_WORDBREAKS) and replaces the last piece only, so what stands before
# that piece is taken off each candidate.
_gpebo() {
    local line="${COMP_LINE:0:COMP_POINT}" cur="${COMP_WORDS[COMP_CWORD]}" word before reply
    word="${line##*[[:space:]]}"
    [[ $cur == [=:] ]] && cur=""
    before="${word%"$cur"}"
    COMPREPLY=()
    while IFS=$'\t' read -r reply _; do
        case $reply in *=|*.|*\[|*/) compopt -o nospace 2>/dev/null ;; esac
        reply="${reply#"$before"}"
        COMPREPLY+=("${reply// /\\ }")
    done < <("${COMP_WORDS[0]}" __complete --line "$line" 2>/dev/null)
}
complete -F _gpebo gpebo
