"""The keywords of ``gymnasium.make``, declared once: constructors, checks, flags and tables follow from here."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from rl2grid.engines import DISPATCHES, ENGINES, HEURISTICS
from rl2grid.envs.tasks import Task, constraint_of
from rl2grid.errors import UsageError, one_of
from rl2grid.mdp.constraint_table import CONSTRAINTS
from rl2grid.mdp.features import ALL_GROUPS, operator_groups
from rl2grid.scenarios.episodes import MAX_STEPS
from rl2grid.scenarios.splits import SPLITS

_LITERAL = re.compile(r'``"?(.*?)"?``')
Function = TypeVar("Function", bound=Callable[..., None])


def _one_of(*choices: str | None) -> dict[str, Any]:
    """What a field knows of its values: these are all."""
    return {"choices": choices}


def _refuse_no_discount(value: object) -> None:
    if value is not None and not (isinstance(value, int | float) and 0 <= value <= 1):
        raise UsageError(f"gamma={value!r} is not allowed: give a discount between 0 and 1, or None.")


def _in_order(operator_features: str | None) -> str | None:
    """The groups in their order, or that they are all."""
    if operator_features is None:
        return None
    groups = operator_groups(operator_features)
    return ALL_GROUPS if groups == operator_groups(ALL_GROUPS) else ",".join(groups)


def _refuse_no_length(value: object) -> None:
    if value is None or (isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MAX_STEPS):
        return
    raise UsageError(
        f"episode_length={value!r} is not allowed: give a number of grid steps from 1 to {MAX_STEPS}, or None."
    )


@dataclass(frozen=True)
class TaskOptions:
    """The keywords of ``gymnasium.make`` and ``make_vec``.

    The metadata of a field say which values it takes: ``"choices"`` lists them, ``"check"`` refuses others;
    ``"flag"`` is what the command line says, where that takes less.

    Raises:
        UsageError: a value is not allowed; the message lists those that are.
    """

    engine: str = field(default="native", metadata=_one_of(*ENGINES))
    """``"native"``: ours, compiled; ``"reference"``: Grid2Op with LightSim2Grid."""
    heuristic: str | None = field(default=None, metadata=_one_of(None, *HEURISTICS))
    """What plays while the grid is safe: ``"idle"``, ``"recovery"``, ``"careful"``; ``"secure"``: while it is safe and
    would bear the loss of any line that may be lost, and no unit is dispatched; None: the agent always decides."""
    reward: str | tuple[float, float, float] | Callable[..., Any] = field(
        default="default",
        metadata={"flag": "default, paper, released or trips, or the weights of the three components, such as 1,0.5,0"},
    )
    """A preset (``"default"``, ``"trips"``, ``"released"``, or ``"paper"``, by which it pays to lose the grid early),
    the weights of the three default components, or a function ``(state, i) -> (survive, overload, cost)``, compiled by
    Numba or plain Python."""
    split: str = field(default="train", metadata=_one_of(*SPLITS))
    """Which scenarios are played: ``"train"`` (months without end), ``"validation"`` (200 months), ``"test"`` (500), or
    ``"bundled"``, the series inside the Grid2Op wheel."""
    scenario: str | None = None
    """Play this scenario only."""
    normalize: str | None = field(default="physical", metadata=_one_of("physical", None))
    """``"physical"``: divide observations by constants of the grid; None: physical units."""
    operator_features: str | None = field(default=None, metadata={"check": operator_groups})
    """What is observed beside the paper's features: some of ``"calendar"``, ``"trips"``, ``"attacks"`` and
    ``"security"``, separated by commas, or ``"all"``; None: nothing."""
    dispatch: str = field(default="exact", metadata=_one_of(*DISPATCHES))
    """How redispatch is solved: ``"exact"``, or ``"grid2op"`` with Grid2Op's own solver."""
    constraint: str | None = field(default=None, metadata=_one_of(None, *CONSTRAINTS))
    """Which cost is ``info["cost"]``; given by the id of constrained tasks."""
    gamma: float | None = field(default=None, metadata={"check": _refuse_no_discount})
    """Adds ``info["discounted_reward"]``: the discounted sum over a transition's grid steps."""
    maintenance: bool = True
    """Whether planned maintenance happens."""
    opponent: bool = True
    """Whether the grid's opponent attacks, if it has one."""
    episode_length: int | None = field(default=None, metadata={"check": _refuse_no_length})
    """Grid steps of a completed episode, such as 2016 for a week; None: 8064, or the series where it is shorter."""

    def __post_init__(self) -> None:
        for option in fields(self):
            _check(option, getattr(self, option.name))
        # One text for one set of features: configurations and identities of results are compared as texts.
        object.__setattr__(self, "operator_features", _in_order(self.operator_features))


OBSERVED_WITH: tuple[str, ...] = ("normalize", "operator_features")
"""Keywords that decide what is observed: a policy reads what it was trained with."""
OPTION_NAMES: tuple[str, ...] = tuple(option.name for option in fields(TaskOptions))
"""All keywords."""


def options_without(*names: str) -> tuple[dataclasses.Field[Any], ...]:
    """The declarations of all keywords but some, for those who are given these otherwise."""
    return tuple(option for option in fields(TaskOptions) if option.name not in names)


@functools.cache
def option_texts() -> dict[str, str]:
    """What each keyword means, in plain words in one line: the text under its field."""
    (declaration,) = ast.parse(inspect.getsource(TaskOptions)).body
    assert isinstance(declaration, ast.ClassDef)
    texts = {}
    for above, below in zip(declaration.body, declaration.body[1:], strict=False):
        if isinstance(above, ast.AnnAssign) and isinstance(above.target, ast.Name) and isinstance(below, ast.Expr):
            texts[above.target.id] = _plain(str(ast.literal_eval(below.value)))
    return texts


def _plain(text: str) -> str:
    return " ".join(_LITERAL.sub(r"\1", text).split())


class UnknownKeywordError(UsageError, TypeError):
    """A keyword that does not exist.

    It is Python's error for one as well, with its words: libraries offer keywords of their own to every environment,
    and try again without the one that is named as unexpected, as TorchRL does with ``frameskip``. Gymnasium puts words
    of its own behind the sentence.
    """


def options_of(task: Task, keywords: Mapping[str, Any], allowed: Iterable[str] = OPTION_NAMES) -> TaskOptions:
    """The options of environments of ``task`` that are made with ``keywords``.

    Args:
        task: the task; the constraint in its id is that of the options.
        keywords: by name.
        allowed: names that messages offer.

    Raises:
        UnknownKeywordError: a keyword does not exist.
        UsageError: a keyword has a value that is not allowed, or contradicts the task.
    """
    for name in keywords:
        if name not in OPTION_NAMES:
            choices = ", ".join(allowed)
            raise UnknownKeywordError(f"There is an unexpected keyword argument {name!r}: choose one of {choices}.")
    options = TaskOptions(**keywords)
    if keywords.get("opponent") and task.grid.opponent.kind == "none":
        raise UsageError(f"opponent=True is not allowed: {task.grid_id} has no opponent; leave it out.")
    return dataclasses.replace(options, constraint=constraint_of(task, options.constraint))


DEFAULTS: Mapping[str, Any] = {option.name: option.default for option in fields(TaskOptions)}
"""The value of each keyword that is not given."""


def changed_options(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """The keywords that are not at their defaults: those filled in to be stored do not count as asked for."""
    return {name: value for name, value in keywords.items() if name not in DEFAULTS or value != DEFAULTS[name]}


def shows_options(init: Function) -> Function:
    """Name the keywords of :class:`TaskOptions` in the signature of a constructor that takes them as ``**keywords``."""
    signature = inspect.signature(init)
    own = [each for each in signature.parameters.values() if each.kind is not inspect.Parameter.VAR_KEYWORD]
    shown = [
        inspect.Parameter(option.name, inspect.Parameter.KEYWORD_ONLY, default=option.default, annotation=option.type)
        for option in fields(TaskOptions)
    ]
    init.__signature__ = signature.replace(parameters=[*own, *shown])  # type: ignore[attr-defined]
    return init


def keyword_names(constructor: Callable[..., Any]) -> tuple[str, ...]:
    """The keywords that a constructor takes, those of its own first."""
    parameters = inspect.signature(constructor).parameters.values()
    return tuple(each.name for each in parameters if each.kind is inspect.Parameter.KEYWORD_ONLY)


def _check(option: dataclasses.Field[Any], value: object) -> None:
    if isinstance(option.default, bool) and not isinstance(value, bool):
        raise UsageError(f"{option.name}={value!r} is not allowed: choose True or False.")
    choices = option.metadata.get("choices")
    if choices and not ((value is None or isinstance(value, str)) and value in choices):
        raise one_of(f"Value for {option.name},", value, choices)
    if "check" in option.metadata:
        option.metadata["check"](value)
