from typing import Any

from . import matlab as matlab

def loadmat(
    file_name: Any, mdict: Any = None, appendmat: bool = True, *, spmatrix: bool = True, **kwargs: Any
) -> dict[str, Any]: ...
