"""Every benchmark in its short form, one after the other, each in a process that has its libraries loaded already.

    python .ci/benchmarks.py [NAME ...]

Loading torch and torchrl takes longer than most of these runs. Exits with 1 where one fails, after all have run.
"""

import importlib
import os
import runpy
import sys
import time
import traceback
from pathlib import Path

HEAVY = ("scipy.stats", "torch", "torchrl.collectors", "torchrl.objectives", "mujoco.batch", "gymnasium", "plotly")
FOLDER = Path(__file__).parents[1] / "benchmarks"


def run(path: Path) -> int:
    """Its exit code, from a fork of this process."""
    child = os.fork()
    if not child:
        code = 1
        try:
            sys.argv, sys.path[0] = [str(path), "--quick"], str(FOLDER)
            runpy.run_path(str(path), run_name="__main__")
            code = 0
        except SystemExit as e:
            code = e.code if isinstance(e.code, int) else int(e.code is not None)
            if isinstance(e.code, str):
                print(e.code, file=sys.stderr)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def main() -> None:
    """Command line."""
    wanted = [FOLDER / f"{name}.py" for name in sys.argv[1:]] or sorted(FOLDER.glob("*.py"))
    for name in HEAVY:
        importlib.import_module(name)
    failed = []
    for path in wanted:
        began = time.monotonic()
        code = run(path)
        print(f"{path.name}: {time.monotonic() - began:.0f} s{f', exit code {code}' if code else ''}", flush=True)
        failed += [path.name] * bool(code)
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
