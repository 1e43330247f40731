from typing import Any

from numpy.typing import ArrayLike, NDArray

def distance_transform_edt(
    input: ArrayLike,
    sampling: ArrayLike | None = None,
    return_distances: bool = True,
    return_indices: bool = False,
    distances: NDArray[Any] | None = None,
    indices: NDArray[Any] | None = None,
) -> Any: ...
def gaussian_filter1d(
    input: ArrayLike,
    sigma: float,
    axis: int = -1,
    order: int = 0,
    output: Any = None,
    mode: str = "reflect",
    cval: float = 0.0,
    truncate: float = 4.0,
    *,
    radius: int | None = None,
) -> NDArray[Any]: ...
