"""How generated months are named: ``17-03``, or ``17-03+04`` for two in a row."""

from __future__ import annotations

import re
from typing import NamedTuple

from rl2grid.errors import UsageError

MONTHS = 12
_NAME = re.compile(r"(?P<seed>0|[1-9]\d{0,18})-(?P<month>\d\d)(\+(?P<next>\d\d))?")


class Months(NamedTuple):
    """One month, or two in a row, of the year of a seed."""

    seed: int
    first: int
    n_months: int

    @property
    def numbers(self) -> range:
        """The months, 0 .. 11."""
        return range(self.first, self.first + self.n_months)


def parse_months(name: str) -> Months:
    """The months that ``name`` stands for.

    Raises:
        UsageError: It stands for none.
    """
    match = _NAME.fullmatch(name)
    if match is not None:
        first = int(match["month"])
        last = first if match["next"] is None else int(match["next"])
        if last < MONTHS and (match["next"] is None or last == first + 1):
            return Months(int(match["seed"]), first, last - first + 1)
    raise UsageError(
        f"Generated scenario {name!r} does not exist: it must look like 17-03 (seed, and month 00 to 11), or 17-03+04 "
        "for two months in a row."
    )


def month_name(seed: int, month: int) -> str:
    """For example ``17-03``."""
    return f"{seed}-{month:02d}"


def name_of(months: Months) -> str:
    """The opposite of :func:`parse_months`."""
    name = month_name(months.seed, months.first)
    return name if months.n_months == 1 else f"{name}+{months.first + 1:02d}"


def scenario_id_of(months: Months) -> str:
    """Of the scenario that they are, for example ``generated/17-03+04``."""
    return f"generated/{name_of(months)}"
