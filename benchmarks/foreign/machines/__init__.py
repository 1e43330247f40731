"""Every case, by name; a module for each sort of machine."""

from ..machine import Case
from . import arms, carts, fingers, flying, heads, hoists, legs, rolling

CASES: dict[str, Case] = {
    case.name: case for module in (arms, carts, fingers, flying, heads, hoists, legs, rolling) for case in module.CASES
}
