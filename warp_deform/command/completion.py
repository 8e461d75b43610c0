"""Completion of the `warp-deform` command in bash, and in zsh by its `bashcompinit`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

__all__ = ["completion_script"]

_SCRIPT = """\
# In bash:  eval "$(warp-deform --completion)"
# In zsh:   autoload -U bashcompinit compinit; compinit; bashcompinit; then the same
_warp_deform() {{
    local words="{verbs}"
    if [ "$COMP_CWORD" -gt 1 ]; then
        case "${{COMP_WORDS[1]}}" in
{cases}
            *) words="" ;;
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _warp_deform warp-deform
"""


def completion_script(words: Mapping[str, Sequence[str]]) -> str:
    """A script for the shell that completes verbs, and after a verb its words; else file names.

    Args:
        words: by verb its flags, and names that it takes
    """
    cases = "\n".join(
        f'            {verb}) words="{" ".join(each)}" ;;' for verb, each in words.items()
    )
    return _SCRIPT.format(verbs=" ".join(words), cases=cases)
