"""`nfc-gym`: the commands, a module for each group of them; what is heavy is imported inside them.

Exit codes: 0 finished, whatever the verdict; 2 bad input; 3 interrupted, the same command resumes; 1 a fault of ours.
"""

import io
import sys
from typing import Annotated

import typer

from nfc_gym import __version__
from nfc_gym.cli import measured, mission, policies, posteriors

app = typer.Typer(
    help="Find what a MuJoCo model lacks, from logs of the real machine, and put it there.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

# In the order of `nfc-gym --help`.
COMMANDS = {
    "check": measured.check,
    "close-loop": measured.close_loop,
    "predict": measured.predict,
    "excite": measured.excite,
    "simulate": posteriors.simulate,
    "train": posteriors.train,
    "infer": posteriors.infer,
    "demo": measured.demo,
    "pretrain": policies.pretrain,
    "play": policies.play,
    "adapt": policies.adapt,
    "learn": mission.learn,
}
for _name, _command in COMMANDS.items():
    app.command(_name)(_command)


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
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
