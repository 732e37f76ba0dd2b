"""Numbers in the cells of a text table, and the words that stand for a number that is not there."""

import re

NAN = float("nan")

UNSEEN_WORDS = frozenset(
    "nan +nan -nan nan(ind) -nan(ind) nan(snan) -nan(snan) 1.#ind -1.#ind 1.#qnan -1.#qnan 1.#inf -1.#inf inf +inf "
    "-inf infinity +infinity -infinity na n/a #n/a #na <na> null none - -- #num! #value! #div/0! #ref! #null!".split()
) | {""}
"""Words for no number, in lower case: those of C and C++ on Linux and Windows, of pandas, R, SQL, MATLAB and Excel."""

_POINT = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?"
NUMBER = {mark: re.compile(_POINT.replace(r"\.", re.escape(mark)), re.ASCII) for mark in ".,"}
"""A number with each decimal mark; Fortran's D is an exponent, an underscore is none of its characters."""
THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+", re.ASCII)
"""A number whose commas may separate thousands."""


def is_number(cell: str, decimal: str) -> bool:
    """Return whether a cell holds a number with that decimal mark."""
    return NUMBER[decimal].fullmatch(cell) is not None


def is_unseen(cell: str) -> bool:
    """Return whether a cell is empty or holds a word for no number."""
    return cell.lower() in UNSEEN_WORDS


def parse_cell(cell: str, decimal: str) -> float:
    """Return the number in a cell; NaN for none.

    Raises:
        ValueError: the cell holds other text.
    """
    if is_number(cell, decimal):
        number = float(cell.replace(",", ".").replace("d", "e").replace("D", "e"))
        return number if abs(number) != float("inf") else NAN
    if is_unseen(cell):
        return NAN
    raise ValueError(cell)
