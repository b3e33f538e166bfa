"""The command line: which command, its options, and how errors end it; `sgam_sfm.runs.supervision.main` starts it."""

from __future__ import annotations

import argparse
import errno
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape

from sgam_core.errors import OptionError, SGAMError
from sgam_sfm.commands.demo import DemoOptions
from sgam_sfm.commands.doctor import DoctorOptions
from sgam_sfm.commands.models import ModelsOptions
from sgam_sfm.commands.show import ShowOptions
from sgam_sfm.commands.status import StatusOptions
from sgam_sfm.comparison.options import CompareOptions
from sgam_sfm.evaluation.options import EvaluateOptions
from sgam_sfm.exit_codes import DONE, ERROR, INTERRUPTED, MEANINGS, USAGE
from sgam_sfm.files import disk_is_full
from sgam_sfm.machine import out_of_memory
from sgam_sfm.nearest import unknown
from sgam_sfm.options import MatchOptions, SegmentOptions, starting_options
from sgam_sfm.pair_lists.options import PairsOptions
from sgam_sfm.stage_options import AggregateOptions, ExportOptions, JoinOptions, LocalizeOptions, ReconstructOptions

_COMMANDS = {
    MatchOptions: "match",
    ReconstructOptions: "reconstruct",
    AggregateOptions: "aggregate",
    LocalizeOptions: "localize",
    ExportOptions: "export",
    JoinOptions: "join",
    CompareOptions: "compare",
    EvaluateOptions: "evaluate",
    PairsOptions: "pairs",
    SegmentOptions: "segment",
    ShowOptions: "show",
    StatusOptions: "status",
    ModelsOptions: "models",
    DoctorOptions: "doctor",
    DemoOptions: "demo",
}
# Commands that take the options of `match` too: what they need besides, and the empty value of each.
_NEEDED: dict[type, dict[str, Any]] = {
    CompareOptions: {"methods": ()},
    EvaluateOptions: {"ground_truth": Path()},
}
# What a folder can refuse; every other OSError would be a mistake of ours, and shows its traceback.
_REFUSALS = {
    errno.EROFS: "the file system is read-only; choose a folder that can be written",
    errno.EACCES: "no permission; choose another folder or change its permissions",
    errno.EPERM: "no permission; choose another folder or change its permissions",
    errno.ENOTDIR: "a file is in the place of a folder; choose another folder",
    errno.EEXIST: "a file is in the place of a folder; choose another folder",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.ELOOP: "its links lead in a circle; choose another folder",
    **dict.fromkeys(
        (errno.EIO, errno.ENXIO, errno.ENODEV, errno.ESTALE, errno.ETIMEDOUT),
        "the file system fails; check the disk or the network share, then start the same command again",
    ),
}


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code; usage errors and `--help` leave by SystemExit (2 and 0)."""
    console = Console(stderr=True)
    if list(arguments) == ["--version"]:
        print(version("sgam-sfm"))
        return DONE
    options: Any = None
    try:
        options = _parse(arguments)
        command = import_module(f"sgam_sfm.commands.{_COMMANDS[type(options)]}")
        return int(command.run(options, console))
    except BrokenPipeError:  # `sgam-sfm models | head -1` has read what it wanted
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except Exception as error:
        message, code = _explained(error, getattr(getattr(options, "method", options), "output", None))
        message = _by_flag(message, arguments) if options is None else message
        console.print(f"[red]error:[/red] {escape(message)}", highlight=False, soft_wrap=True)
        return code
    except KeyboardInterrupt:
        console.print("stopped; the same command continues where it was")
        return INTERRUPTED


def _by_flag(message: str, arguments: Sequence[str]) -> str:
    """What is wrong with an option of the algorithm, `max_crop_pixels is -5; ...`, by the flag that was given."""
    name, _, rest = message.partition(" ")
    flags = [argument.partition("=")[0] for argument in arguments if argument.startswith("--")]
    given = [flag for flag in flags if flag[2:].rpartition(".")[2].replace("-", "_") == name]
    return f"{given[-1]} {rest}" if given else message


def _parse(arguments: Sequence[str]) -> Any:
    known = {name: options for options, name in _COMMANDS.items()}
    if arguments and not arguments[0].startswith("-"):
        return _parse_command(arguments[0], arguments[1:], known)
    commands: Any = Annotated[MatchOptions, tyro.conf.subcommand("match", default=_defaults((), MatchOptions))]
    for options, name in _COMMANDS.items():
        if options is not MatchOptions:
            commands |= Annotated[options, tyro.conf.subcommand(name)]
    return tyro.cli(
        commands,
        prog="sgam-sfm",
        description="Semantic area-to-point matching (SGAM) for COLMAP.\n\n" + MEANINGS,
        args=arguments,
    )


_HELP = tyro.constructors.ConstructorRegistry()
_NOT_GIVEN = ["not", "given"]


@_HELP.primitive_rule
def _path_or_none(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """`PATH (default: not given)` in the help, in place of `{None}|PATH (default: None)`."""
    if info.type != Path | None:
        return None
    return _one_value(info, "PATH", lambda text: None if text == "None" else Path(text))


@_HELP.primitive_rule
def _text(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """`TEXT (default: not given)` in the help, in place of `STR (default: '')`."""
    return _one_value(info, "TEXT", str) if info.type is str else None


def _one_value(
    info: tyro.constructors.PrimitiveTypeInfo, metavar: str, read: Callable[[str], Any]
) -> tyro.constructors.PrimitiveConstructorSpec:
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda texts: read(texts[0]),
        is_instance=lambda value: isinstance(value, info.type),
        str_from_instance=lambda value: [str(value)] if value else _NOT_GIVEN,
    )


def _parse_command(name: str, arguments: Sequence[str], known: Mapping[str, type]) -> Any:
    if name not in known:
        raise OptionError(unknown("command", name, known))
    options: Any = known[name]
    default = _defaults(arguments, options) if issubclass(options, MatchOptions) else None
    given = {} if default is None else {"default": default}
    return tyro.cli(
        Annotated[options, tyro.conf.OmitSubcommandPrefixes],
        prog=f"sgam-sfm {name}",
        args=arguments,
        registry=_HELP,
        **given,
    )


def _defaults(arguments: Sequence[str], command: type[MatchOptions]) -> Any:
    """The values that flags of `match` or `compare` are laid over: the preset's, then the file's."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--config", type=Path)
    early.add_argument("--preset")
    known, _ = early.parse_known_args(arguments)
    start = starting_options(known.config, known.preset)
    values: dict[str, Any] = {option.name: getattr(start, option.name) for option in fields(start)}
    needed = {"images": Path(), "output": Path()} | _NEEDED.get(command, {})
    made = command(**(needed | values))
    for name, empty in needed.items():
        if getattr(made, name) == empty:
            object.__setattr__(made, name, tyro.MISSING)  # of no option's type: tells tyro that the flag is required
    return made


def _explained(error: Exception, output: object) -> tuple[str, int]:
    """One line for an error that a user can mend, and its exit code; any other is a mistake of ours: its traceback.

    Args: output: where the command was to write, if it got so far.
    """
    if disk_is_full(error):
        return "the disk is full; free some space, then start the same command again", ERROR
    if out_of_memory(error) and not isinstance(error, SGAMError):
        return (
            f"memory does not suffice ({str(error) or type(error).__name__}); lower --image-size or --max-image-size",
            ERROR,
        )
    if isinstance(error, SGAMError):
        return str(error), USAGE if isinstance(error, OptionError) else ERROR
    if isinstance(error, OSError) and error.errno in _REFUSALS:
        return f"'{error.filename}' cannot be written: {_REFUSALS[error.errno]}", ERROR
    ours = (output, *output.parents) if isinstance(output, Path) else ()
    if isinstance(error, FileNotFoundError) and Path(str(error.filename)) in ours:
        return f"'{output}' cannot be made ({error.strerror}: '{error.filename}'); choose another --output", ERROR
    raise error
