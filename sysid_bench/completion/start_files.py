"""Scripts that make a shell ask this program for completions."""

from collections.abc import Mapping
from typing import Final

_BASH: Final = r"""
_sysid_bench() {
    local answer  # mapfile reads a pipe byte by byte
    answer=$(SYSID_BENCH_BREAKS="$COMP_WORDBREAKS" \
        "${COMP_WORDS[0]}" complete bash "${COMP_LINE:0:COMP_POINT}" 2>/dev/null)
    COMPREPLY=()
    [[ -z $answer ]] || mapfile -t COMPREPLY <<< "$answer"
    if [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[/=:] ]]; then compopt -o nospace; fi
}
complete -o nosort -F _sysid_bench sysid-bench
"""
_ZSH: Final = r"""
_sysid_bench() {
    local -a whole begun
    local value title
    while IFS=$'\t' read -r value title; do
        case "$value" in
            (*[/=:]) begun+=("$value") ;;
            (*) whole+=("$value") ;;
        esac
    done < <("${words[1]}" complete zsh "${(j: :)words[1,CURRENT-1]} $PREFIX" 2>/dev/null)
    compadd -a whole
    compadd -S '' -a begun
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _sysid_bench sysid-bench
"""
_FISH: Final = r"""
complete -c sysid-bench -f -a '(sysid-bench complete fish (commandline -cp) 2>/dev/null)'
"""
SCRIPTS: Final[Mapping[str, str]] = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}
"""Script of each shell."""

START_FILES: Final[Mapping[str, str]] = {
    "bash": "~/.bashrc",
    "zsh": "~/.zshrc",
    "fish": "~/.config/fish/config.fish",
}
"""File that each shell reads when it starts."""
