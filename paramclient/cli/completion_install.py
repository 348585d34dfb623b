"""Install shell completion for bash, zsh and fish."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Final, Literal, TypeAlias, get_args

from platformdirs import user_config_path, user_data_path

from paramclient.cli.completion import COMPLETION_VARIABLE, read_table
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.output import say
from paramclient.errors import UsageError

__all__ = ["SCRIPTS", "Shell", "install"]

Shell: TypeAlias = Literal["bash", "zsh", "fish"]
"""The shells with completion."""

SCRIPTS: Final[dict[str, str]] = {
    "bash": f"""\
_paramclient() {{
    local IFS=$'\\n'
    COMPREPLY=($({COMPLETION_VARIABLE}=bash COMP_LINE="$COMP_LINE" COMP_POINT="$COMP_POINT" \\
        COMP_WORDBREAKS="$COMP_WORDBREAKS" "$1" 2>/dev/null))
    if [[ ${{COMPREPLY[0]}} == *: ]]; then compopt -o nospace; fi
}}
complete -o default -F _paramclient paramclient
""",
    "zsh": f"""\
#compdef paramclient
_paramclient() {{
    local -a found
    found=("${{(@f)$({COMPLETION_VARIABLE}=zsh "${{(@Q)words[1,CURRENT]}}" 2>/dev/null)}}")
    if [[ -n "${{found[1]}}" ]]; then _describe paramclient found; else _files; fi
}}
(( $+functions[compdef] )) || {{ autoload -Uz compinit && compinit; }}
compdef _paramclient paramclient
""",
    "fish": f"""\
function __paramclient_complete
    set -l words (commandline -opc)
    set -a words (commandline -ct | string collect --allow-empty)
    set -l found (env {COMPLETION_VARIABLE}=fish $words 2>/dev/null)
    if test (count $found) -gt 0
        printf '%s\\n' $found
    else
        __fish_complete_path (commandline -ct)
    end
end
complete -c paramclient -f -a '(__paramclient_complete)'
""",
}
"""The script of each shell. It asks the command for candidates, and completes file names if it has none."""
_MARK: Final = "# paramclient completion"
"""End of the line in the start-up file of bash or zsh."""


def install(shell: Shell | None = None, /) -> ExitCode:
    """Install completion of subcommands, options, vehicles and parameter names for a shell.

    For bash and zsh, the script is put into the user's data folder, and a line that loads it into ~/.bashrc
    or ~/.zshrc. fish finds its script in its own folder.

    Args:
        shell: bash, zsh or fish. Default: the shell that $SHELL names.
    """
    chosen = shell or Path(os.environ.get("SHELL", "")).name
    if chosen not in get_args(Shell):
        raise UsageError(
            f"completion is for {', '.join(get_args(Shell))}, and $SHELL is {chosen or 'not set'}; name one: "
            "paramclient --install-completion bash"
        )
    try:
        script, start = _install(chosen)
    except OSError as error:
        raise UsageError(f"completion cannot be installed: {error}") from error
    read_table()  # the first press of the key would have to wait for it
    say(f"completion for {chosen}: {script}" + (f", loaded by {start}" if start else ""))
    say("it works in new shells")
    return ExitCode.DONE


def _install(shell: str) -> tuple[Path, Path | None]:
    """Write the script of a shell and the line that loads it; return both paths."""
    if shell == "fish":
        script, start = user_config_path("fish") / "completions" / "paramclient.fish", None
    else:
        script = user_data_path("paramclient", appauthor=False) / f"completion.{shell}"
        folder = os.environ.get("ZDOTDIR") if shell == "zsh" else None
        start = (Path(folder) if folder else Path.home()) / f".{shell}rc"
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(SCRIPTS[shell], encoding="utf-8")
    if start is not None:
        text = start.read_text(encoding="utf-8", errors="surrogateescape") if start.exists() else ""
        line = f"source {shlex.quote(str(script))} {_MARK}\n"
        kept = "".join(each for each in text.splitlines(keepends=True) if not each.rstrip().endswith(_MARK))
        if kept and not kept.endswith("\n"):
            kept += "\n"
        start.write_text(kept + line, encoding="utf-8", errors="surrogateescape")
    return script, start
