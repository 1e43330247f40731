"""`nfc-gym`: the commands, a module for each group of them; what is heavy is imported inside them.

Exit codes: 0 finished, whatever the verdict; 2 bad input; 3 interrupted, the same command resumes; 1 a fault of ours.
"""

import inspect
import io
import sys
from typing import Annotated

import typer

import nfc_gym
from nfc_gym.cli import detectors, measured, mission, policies, posteriors


def flowing(text: str | None) -> str:
    """A docstring as help shows it: the lines of a paragraph flow together, indented lines stay as they are."""
    paragraphs = inspect.cleandoc(text or "").split("\n\n")
    return "\n\n".join(p if p.startswith(" ") or "\n " in p else p.replace("\n", " ") for p in paragraphs)


app = typer.Typer(
    help=flowing(nfc_gym.__doc__), no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False
)

# In the groups and the order of `nfc-gym --help`.
COMMANDS = {
    "Logs of a machine": {
        "check": measured.check,
        "close-loop": measured.close_loop,
        "predict": measured.predict,
        "excite": measured.excite,
        "demo": measured.demo,
    },
    "Posteriors and detectors": {
        "simulate": posteriors.simulate,
        "train": posteriors.train,
        "infer": posteriors.infer,
        "watch": detectors.watch,
        "learn": mission.learn,
    },
    "Policies": {
        "pretrain": policies.pretrain,
        "play": policies.play,
        "adapt": policies.adapt,
    },
}
for _group, _commands in COMMANDS.items():
    for _name, _command in _commands.items():
        app.command(_name, help=flowing(_command.__doc__), rich_help_panel=_group)(_command)


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(nfc_gym.__version__)
        raise typer.Exit


@app.callback()
def _options(
    ctx: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Say it.")] = False,
) -> None:
    ctx.obj = debug


def main() -> None:
    """The entry point of `nfc-gym`; `--debug` may stand anywhere on the line."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # what a terminal cannot show is no reason to fail
    args = [a for a in sys.argv[1:] if a != "--debug"]
    app(["--debug", *args] if len(args) < len(sys.argv) - 1 else args, prog_name="nfc-gym")
