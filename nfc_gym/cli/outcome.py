"""What a command ends with: where its result is, or one clear message on stderr and the exit code for it."""

import errno
import signal
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import typer
from rich.console import Console

from nfc_gym.core import NfcError

FAULT, BAD_INPUT, INTERRUPTED = 1, 2, 3

# What the operating system may refuse, and what the user can do about it.
_REFUSALS = {
    errno.ENOSPC: "the disk is full: free some space and run the same command again",
    errno.EDQUOT: "your disk quota is used up: free some space and run the same command again",
    errno.EACCES: "permission denied: choose a place that you may write to, or change the permissions",
    errno.EPERM: "not permitted: choose a place that you may write to, or change the permissions",
    errno.ENAMETOOLONG: "a name is too long for this file system: choose a shorter one",
    errno.EROFS: "the file system is read-only: choose another --out",
}


@contextmanager
def outcome(ctx: typer.Context, resumes: bool = False) -> Iterator[None]:
    """Turn whatever a command raises into one clear message on stderr and the exit code that goes with it."""
    try:
        with _terminable():
            yield
    except typer.Exit:
        raise
    except KeyboardInterrupt:
        again = "goes on from what it had finished" if resumes else "starts over"
        _fail(ctx, INTERRUPTED, f"interrupted; the same command {again}")
    except NfcError as e:
        _fail(ctx, BAD_INPUT, str(e))
    except OSError as e:
        refusal = _REFUSALS.get(e.errno or 0) or (_REFUSALS[errno.ENOSPC] if "No space left" in str(e) else None)
        if refusal is None:
            _fault(ctx, e)
        _fail(ctx, BAD_INPUT, f"{e.filename}: {refusal}" if e.filename else refusal)
    except Exception as e:
        _fault(ctx, e)


@contextmanager
def _terminable() -> Iterator[None]:
    """A request to terminate (SIGTERM, as job schedulers send it) interrupts like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():  # only there may handlers be set
        yield
        return

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _fail(ctx: typer.Context, code: int, message: str) -> NoReturn:
    console = Console(stderr=True, soft_wrap=True, highlight=False, emoji=False)
    if ctx.obj:
        console.print(traceback.format_exc(), markup=False)
    console.print(f"nfc-gym {ctx.info_name}: {printable(message)}", markup=False)
    raise typer.Exit(code)


def say_written(path: Path, what: str) -> None:
    """One line on stdout: where a result is, and what it is."""
    typer.echo(printable(f"{path}: {what}"))


def printable(text: str) -> str:
    """File names may hold bytes that are no text: these are shown as escapes."""
    return text.encode(errors="backslashreplace").decode()


def _fault(ctx: typer.Context, error: Exception) -> NoReturn:
    hint = "" if ctx.obj else "; the same command with --debug shows where"
    what = " ".join(f"{type(error).__name__}: {error}".split())
    _fail(
        ctx,
        FAULT,
        f"a fault of nfc-gym, not of yours: {what}{hint}. Please report it with that output and the mapping.",
    )
