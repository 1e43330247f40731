from typing import Any

from numpy.typing import ArrayLike, NDArray

def rankdata(
    a: ArrayLike, method: str = "average", *, axis: int | None = None, nan_policy: str = "propagate"
) -> NDArray[Any]: ...
