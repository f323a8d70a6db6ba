"""Commands: one thin file each, of one shape.

`cli/<command>.py` holds a frozen, keyword-only dataclass `Options`, whose field docstrings are the command line's
help (tyro) and whose own docstring's is the command's, and a function `run(options: Options) -> int` that gives the
exit code; where defaults follow from the first word, also `parse(arguments, prog) -> Options`. At module top it imports
nothing heavy (no torch, cv2, rich): help must be instant. Results go to standard output, everything else to standard
error (`console.py`); with `--json`, standard output is one JSON value.

What a user can get wrong is a ValueError (`CaptureError` is one) or an OSError and ends here as one line on standard
error with exit code 2; any other exception is our mistake and shows its traceback, exit code 1. Ctrl-C ends with 130,
SIGTERM with 143; either way what was begun is removed.
"""

import importlib
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from viewmend import __version__
from viewmend.cli.console import say
from viewmend.cli.signals import ended_by_sigterm
from viewmend.terminal import log_to_terminal, printable_traceback


@dataclass(frozen=True)
class Command:
    """A subcommand: the module that runs it and its line in the overview."""

    name: str
    """One word, or two: `evaluate parity` is found before `evaluate`."""
    module: str
    summary: str


COMMANDS = (
    Command("demo", "viewmend.cli.demo", "Render and mend a moving procedural scene; needs nothing."),
    Command("serve", "viewmend.cli.serve", "Walk around the subject in a browser, live."),
    Command("mend", "viewmend.cli.mend", "Mend novel views of a capture."),
    Command("studio", "viewmend.cli.studio", "Write synthetic captures with exact truth."),
    Command("train", "viewmend.cli.train", "Train a model, or fine-tune one on your own capture."),
    Command("samples", "viewmend.cli.samples", "Make training samples ahead."),
    Command("ablation", "viewmend.cli.ablation", "Train every variant of the model and compare them."),
    Command("evaluate", "viewmend.cli.evaluate", "Compare methods on fixed scenes and captures."),
    Command("evaluate parity", "viewmend.cli.parity", "Compare our baselines with the published networks."),
    Command("evaluate paper-table", "viewmend.cli.paper_table", "The paper's tables on your data, beside its figures."),
    Command("benchmark", "viewmend.cli.benchmark", "Measure what a view costs here, stage by stage."),
    Command("weights", "viewmend.cli.weights", "List and check weights of others' networks."),
    Command("masks", "viewmend.cli.masks", "Make masks for a capture that has none."),
    Command("calibrate", "viewmend.cli.calibrate", "Find a rig's cameras from a board, or refine them by silhouettes."),
    Command(
        "splits", "viewmend.cli.splits", "Split captures for training and tests by the paper's protocol, as a file."
    ),
    Command("convert", "viewmend.cli.convert", "Write a capture of any format as a plain one."),
    Command(
        "export-scene", "viewmend.cli.export_scene", "Write a capture as a scene for engines: hull, points, depth."
    ),
    Command("export", "viewmend.cli.export", "Write a model for C++ and other runtimes: AOTInductor or ONNX."),
    Command("info", "viewmend.cli.info", "Say what a capture or a model is, and check a calibration."),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `viewmend` with these arguments (those of the process by default); the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        print(f"viewmend {__version__}")
        return 0
    by_name = {c.name: c for c in COMMANDS}
    command = by_name.get(" ".join(arguments[:2])) or by_name.get(arguments[0])
    if command is None:
        names = ", ".join(c.name for c in COMMANDS)
        return _fail(f"expected a command among {names}, got '{arguments[0]}'; see viewmend --help")
    empty = [n for n, word in enumerate(arguments) if not word.strip() or re.fullmatch(r"--[\w-]+=\s*", word)]
    if empty:
        before = arguments[empty[0] - (not arguments[empty[0]].strip())]
        return _fail(f"expected a value after '{before.rstrip('= ')}', got an empty one; is a variable unset?")
    log_to_terminal()
    with ended_by_sigterm():
        return _run(command, arguments[len(command.name.split()) :])


def _run(command: Command, arguments: list[str]) -> int:
    try:
        import tyro

        module = importlib.import_module(command.module)
        prog, flags = f"viewmend {command.name}", (tyro.conf.FlagCreatePairsOff,)
        if hasattr(module, "parse"):
            options = module.parse(arguments, prog)
        else:
            options = tyro.cli(module.Options, args=arguments, prog=prog, config=flags)
        return int(module.run(options) or 0)
    except SystemExit as exit_request:  # tyro's: 0 after --help, 2 after a wrong option
        return exit_request.code if isinstance(exit_request.code, int) else 2
    except KeyboardInterrupt:
        say("viewmend: interrupted")
        return 130
    except BrokenPipeError:  # the reader of our output left: nothing to say, and nobody to say it to
        sys.stderr.close()
        return 1
    except OSError as error:
        advice = "" if error.filename is None else "; is that the place you meant, and may you write there?"
        return _fail(f"{error}{advice}")
    except ValueError as error:
        return _fail(str(error))
    except Exception as error:
        print(printable_traceback(error), file=sys.stderr, flush=True)
        return 1


def _fail(message: str) -> int:
    say(f"viewmend: error: {' '.join(message.split())}")
    return 2


def _overview() -> str:
    width = max(len(c.name) for c in COMMANDS) + 2
    lines = [f"  {c.name:<{width}}{c.summary}" for c in COMMANDS]
    return "\n".join(
        [
            "usage: viewmend COMMAND [options]",
            "",
            "Fills the holes of free-viewpoint video of people captured by a few calibrated cameras.",
            "",
            "commands:",
            *lines,
            "",
            "viewmend COMMAND --help shows a command's options; viewmend --version the version.",
        ]
    )
