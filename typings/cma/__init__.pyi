"""What this package uses of pycma, which says few types."""

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import ArrayLike, NDArray

class CMAEvolutionStrategy:
    best: Any
    def __init__(
        self,
        x0: ArrayLike,
        sigma0: float,
        inopts: Mapping[str, Any] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None: ...
    def ask(
        self,
        number: int | None = None,
        xmean: ArrayLike | None = None,
        sigma_fac: float = 1,
        gradf: Any = None,
        args: Sequence[Any] = (),
        **kwargs: Any,
    ) -> list[NDArray[Any]]: ...
    def tell(
        self,
        solutions: Any,
        function_values: Any,
        check_points: Any = None,
        copy: bool = False,
        constraints_values: Any = None,
    ) -> None: ...
    def stop(
        self,
        check: bool = True,
        ignore_list: Sequence[str] = (),
        check_in_same_iteration: bool = False,
        get_value: str | None = None,
    ) -> dict[str, Any]: ...
