"""The `viewmend` command: one module per subcommand.

`cli/<command>.py` holds a frozen, keyword-only dataclass `Options` and a function
`run(options) -> int` that returns the exit code. tyro turns the field docstrings into the option
help and the class docstring into the command help. A command whose defaults depend on its first
argument also has `parse(arguments, prog) -> Options`. No command module imports torch, cv2 or rich
at the top, so that help appears at once. Results go to standard output, all other messages to
standard error (`console.py`); with `--json`, standard output is one JSON value.

Exit codes: 2 for a `ValueError` (`CaptureError` is one) or an `OSError`, reported in one
line; 1 for failures that a report lists, or with a traceback for any other exception, which
is a bug; 130 after Ctrl-C and 143 after SIGTERM. Partial output is removed, except what a
repeated command resumes from.
"""

import importlib
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from viewmend import __version__
from viewmend.cli.console import escape_unencodable, exit_on_sigterm, say, show, use_utf8_names
from viewmend.utils.logging import escaped_traceback, log_to_terminal

ALIASES = {"info": "check"}
"""Former names of commands. They still work, but the overview does not list them."""

COMMANDS = {
    "demo": "Render and inpaint a synthetic scene. Needs no data.",
    "view": "Open a capture in the browser.",
    "serve": "Serve a capture or a live rig to browsers.",
    "publish": "Write a capture as a web page of static files.",
    "mend": "Render and inpaint novel views of a capture.",
    "studio": "Generate synthetic captures with ground truth.",
    "train": "Train a model, or fine-tune one on your own capture.",
    "make-dataset": "Generate training samples in advance.",
    "evaluate": "Compare methods on standard scenes and on captures.",
    "evaluate paper-table": "Compute the paper's tables on your own data.",
    "weights": "List third-party weights.",
    "weights get": "Download the networks of LPIPS (VGG16) and VFID (I3D).",
    "masks": "Make masks for a capture.",
    "calibrate": "Calibrate cameras with a board, or refine them with silhouettes.",
    "splits": "Write a train/test split of captures.",
    "convert": "Convert a capture of any supported format.",
    "export-scene": "Export a capture for game engines: mesh, points, depth.",
    "export": "Export a model for C++ and other runtimes.",
    "check": "Check a capture, and describe it.",
}
"""The summary of each command, in the order of the overview. The module of `make-dataset` is
`make_dataset`, that of `weights get` is `weights_get`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run `viewmend` with these arguments (by default those of the process) and return the exit code."""
    if argv is None:
        use_utf8_names()
    escape_unencodable()
    with exit_on_sigterm():
        return _run(list(sys.argv[1:] if argv is None else argv))


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        show(*_overview().splitlines())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        show(f"viewmend {__version__}")
        return 0
    two_words = " ".join(arguments[:2])
    command = two_words if two_words in COMMANDS else ALIASES.get(arguments[0], arguments[0])
    if command not in COMMANDS:
        names = ", ".join(COMMANDS)
        return _fail(f"expected a command among {names}, got '{arguments[0]}'; see viewmend --help")
    for number, word in enumerate(arguments):
        if not word.strip() or re.fullmatch(r"--[\w-]+=\s*", word):
            option = arguments[number - (not word.strip())].rstrip("= ")
            return _fail(f"expected a value after '{option}', got an empty one; is a variable unset?")
    log_to_terminal()
    import tyro

    # Shells expand ~ only at the beginning of a word
    arguments = [re.sub(r"^(--[\w-]+=)?~(?=/|$)", _with_home, word) for word in arguments]
    arguments = arguments[len(command.split()) :]
    module = importlib.import_module(f"viewmend.cli.{re.sub('[ -]', '_', command)}")
    prog = f"viewmend {command}"
    flags = (tyro.conf.FlagCreatePairsOff,)
    if hasattr(module, "parse"):
        options = module.parse(arguments, prog)
    else:
        options = tyro.cli(module.Options, args=arguments, prog=prog, config=flags)
    return int(module.run(options) or 0)


def _with_home(start: re.Match[str]) -> str:
    """The option before a `~`, if any, and the user's folder."""
    return (start.group(1) or "") + str(Path.home())


def _run(arguments: list[str]) -> int:
    try:
        return _dispatch(arguments)
    except SystemExit as request:  # from tyro: 0 after --help, 2 after a wrong option
        return request.code if isinstance(request.code, int) else 2
    except KeyboardInterrupt:
        say("viewmend: interrupted")
        return 130
    except BrokenPipeError:  # the program that reads our output has exited
        sys.stderr.close()
        return 1
    except OSError as error:
        advice = "" if error.filename is None else "; check the path and its permissions"
        return _fail(f"{error}{advice}")
    except ValueError as error:
        return _fail(str(error))
    except Exception as error:
        print(escaped_traceback(error), file=sys.stderr, flush=True)
        return 1


def _fail(message: str) -> int:
    say(f"viewmend: error: {' '.join(message.split())}")
    return 2


def _overview() -> str:
    width = max(map(len, COMMANDS)) + 2
    commands = "\n".join(f"  {command:<{width}}{summary}" for command, summary in COMMANDS.items())
    return f"""usage: viewmend COMMAND [options]

Free-viewpoint video of people from a few calibrated cameras, with its holes filled live.

commands:
{commands}

viewmend COMMAND --help lists the options of a command; viewmend --version prints the version."""
