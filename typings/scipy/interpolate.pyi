from typing import Any

from numpy.typing import ArrayLike, NDArray

class CubicSpline:
    def __init__(
        self, x: ArrayLike, y: ArrayLike, axis: int = 0, bc_type: Any = "not-a-knot", extrapolate: Any = None
    ) -> None: ...
    def __call__(self, x: ArrayLike, nu: int = 0, extrapolate: Any = None) -> NDArray[Any]: ...
    def derivative(self, nu: int = 1) -> CubicSpline: ...
