"""Shell completion of commands, options, groups, keys, values and artifacts, the same for bash, zsh and fish."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import is_dataclass
from enum import Enum
from typing import Any, Literal, get_args, get_origin

from stages.convert import ConfigError, hints
from stages.registry import MODULES

SCRIPTS = {
    # Bash splits words at `=` and `:`, so the answer is cut back to what follows the last one.
    "bash": """_wbm() {
    local line="${COMP_LINE:0:COMP_POINT}" word
    word="${line##*[[:space:]]}"
    local IFS=$'\\n' cut="${COMP_WORDS[COMP_CWORD]}"
    case "$word" in *[=:]*) cut="${word##*[=:]}" ;; esac
    COMPREPLY=($(wbm --complete "$line" 2>/dev/null))
    COMPREPLY=("${COMPREPLY[@]#"${word%"$cut"}"}")
    case "${COMPREPLY[*]}" in *[=.,]) compopt -o nospace 2>/dev/null ;; esac
}
complete -F _wbm wbm
""",
    "zsh": """#compdef wbm
_wbm() {
    local -a found
    found=("${(@f)$(wbm --complete "$LBUFFER" 2>/dev/null)}")
    (( ${#found} )) && compadd -S '' -Q -- $found
}
compdef _wbm wbm
""",
    "fish": """function __wbm_complete
    wbm --complete (commandline -cp) 2>/dev/null
end
complete -c wbm -f -a '(__wbm_complete)'
""",
}


def script(shell: str) -> None:
    """Print the completion script of a shell.

    Raises:
        ConfigError: an unknown shell.
    """
    if shell not in SCRIPTS:
        raise ConfigError(f"completion {shell}: choose one of {', '.join(SCRIPTS)}")
    sys.stdout.write(SCRIPTS[shell])


def answer(line: str) -> None:
    """Print the candidates for the last word of a command line, one a line."""
    sys.stdout.write("".join(f"{word}\n" for word in complete(_split(line)[1:])))


def _split(line: str) -> list[str]:
    try:
        words = shlex.split(line)
    except ValueError:
        words = line.split()
    return [*words, ""] if not line or line[-1].isspace() else words


def complete(words: Sequence[str]) -> list[str]:
    """Candidates for the last of `words`, the words after `wbm`; whole words, sorted."""
    from typer.main import get_command

    from stages.cli import app

    command: Any = get_command(app)
    path: list[str] = []
    *before, word = words or [""]
    for item in before:
        if item in getattr(command, "commands", {}):
            command = command.commands[item]
            path.append(item)
    if hasattr(command, "commands"):
        return _matching(word, [*command.commands, "--help"] if word.startswith("-") else command.commands)
    if word.startswith("-"):
        return _matching(word, [name for p in command.params for name in getattr(p, "opts", []) if name[0] == "-"])
    if before and before[-1] == "--until":
        return _matching(word, MODULES)
    if before and before[-1] == "--from":
        return _matching(word, ["reference"])
    if before and before[-1] == "--launcher":
        return _matching(word, ["local", "slurm"])
    if path == ["completion"]:
        return _matching(word, SCRIPTS)
    if "=" not in word and (path[:1] == ["artifacts"] or path in (["repro-diff"], ["view"])):
        return [*artifacts(word), *_matching(word, ["artifacts.root="])]
    return candidates(word)


def _matching(word: str, choices: Iterable[str]) -> list[str]:
    return sorted({choice for choice in choices if choice.startswith(word)})


def artifacts(word: str) -> list[str]:
    """Published artifacts that begin with `word`, level by level."""
    from stages.commands import composer, open_store

    store = open_store(composer([]))
    names = [*store.names(), *store.references.names()]
    depth = word.count("/") + 1
    return _matching(word, ["/".join(n.split("/")[:depth]) + ("/" if depth == 1 else "") for n in names])


def candidates(word: str) -> list[str]:
    """Settings that begin with `word`: groups with their presets, keys level by level, values of a key."""
    from stages import compose

    prefix = word[:2] if word.startswith("++") else word[:1] if word[:1] in ("+", "~") else ""
    body = word[len(prefix) :]
    if "=" in body:
        key, _, typed = body.partition("=")
        head, comma, last = typed.rpartition(",")
        values = compose.presets(key) or _values(key)
        return _matching(word, [f"{prefix}{key}={head}{comma}{value}" for value in values if value.startswith(last)])
    depth = body.count(".") + 1
    offers = [f"{group}=" for group in compose.groups()]
    for key in compose.all_keys():
        parts = key.split(".")
        offers.append(".".join(parts[:depth]) + ("=" if len(parts) <= depth else "."))
    return _matching(word, [prefix + offer for offer in offers])


def _values(key: str) -> list[str]:
    from stages.config import Config

    hint: Any = Config
    for part in key.split("."):
        if not (isinstance(hint, type) and is_dataclass(hint)) or part not in hints(hint):
            args = get_args(hint)
            if get_origin(hint) is not dict or len(args) != 2:
                return []
            hint = args[1]
            continue
        hint = hints(hint)[part]
    options = [hint, *get_args(hint)] if get_origin(hint) is not Literal else [hint]
    out: list[str] = ["null"] if type(None) in options else []
    for option in options:
        if get_origin(option) is Literal:
            out += [str(choice) for choice in get_args(option)]
        elif option is bool:
            out += ["true", "false"]
        elif isinstance(option, type) and issubclass(option, Enum):
            out += [str(member.value) for member in option]
    return out + (artifacts("") if key == "policy" or key.startswith("inputs.") else [])
