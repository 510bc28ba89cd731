"""What may be compiled: refuse, by name, every Grid2Op feature that the native engine does not simulate.

Alarms and alerts are no such feature: they change rewards, not what the grid does.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from grid2op.Environment import Environment, MaskedEnvironment, TimedOutEnvironment
from grid2op.Environment.dispatch import DefaultRedispatchSolver
from grid2op.Opponent import BaseActionBudget
from grid2op.Rules import DefaultRules, RulesByArea
from grid2op.VoltageControler import ControlVoltageFromFile
from lightsim2grid import LightSimBackend

from rl2grid.engines.dispatch import EPSILON, TOLERANCE
from rl2grid.engines.reference.dispatch import ExactRedispatchSolver
from rl2grid.engines.reference.extract import OPPONENT_KINDS, environment_name, read_series
from rl2grid.errors import UsageError
from rl2grid.grids import STEPS_PER_HOUR

PARAMETERS: dict[str, float] = {
    "NO_OVERFLOW_DISCONNECTION": False,
    "SOFT_OVERFLOW_THRESHOLD": 1.0,
    "ENV_DC": False,
    "FORECAST_DC": False,
    "IGNORE_MIN_UP_DOWN_TIME": True,
    "ALLOW_DISPATCH_GEN_SWITCH_OFF": True,
    "LIMIT_INFEASIBLE_CURTAILMENT_STORAGE_ACTION": False,
    "INIT_STORAGE_CAPACITY": 0.5,
    "ACTIVATE_STORAGE_LOSS": True,
    "IGNORE_INITIAL_STATE_TIME_SERIE": False,
    "MAX_SIMULATE_PER_STEP": -1,
    "MAX_SIMULATE_PER_EPISODE": -1,
    "ENV_DOES_REDISPATCHING": True,
    "STOP_EP_IF_GEN_BREAK_CONSTRAINTS": False,
}
"""Parameters (``grid2op.Parameters``) that a step depends on, with the only value simulated."""

FREE_PARAMETERS: tuple[str, ...] = (
    "NB_TIMESTEP_OVERFLOW_ALLOWED",
    "NB_TIMESTEP_RECONNECTION",
    "NB_TIMESTEP_COOLDOWN_LINE",
    "NB_TIMESTEP_COOLDOWN_SUB",
    "HARD_OVERFLOW_THRESHOLD",
    "MAX_SUB_CHANGED",
    "MAX_LINE_STATUS_CHANGED",
)
"""Parameters that a step depends on and that :class:`rl2grid.grids.Rules` holds."""

LARGEST_INDEX = 65_535
"""Of the 16 bits in which the power flow numbers its unknowns, two per busbar, and the entries of its admittances."""


def require_supported(environment: Any) -> None:
    """Refuse an environment that has a feature which is not simulated.

    Raises:
        UsageError: names the first such feature.
    """
    if not isinstance(environment, Environment) or isinstance(environment, MaskedEnvironment | TimedOutEnvironment):
        raise UsageError(
            f"A {type(environment).__name__} cannot be compiled: give a plain grid2op Environment, "
            "of a multi-mix environment one mix."
        )
    _refuse_first(environment, _environment_problems(environment))


def require_supported_model(environment: Any, grid_model: Any) -> None:
    """Refuse an initial electrical model that has a feature which is not simulated.

    Args:
        environment: the ``grid2op.Environment``.
        grid_model: its ``LightSimBackend._grid`` after ``LightSimBackend.reset``.

    Raises:
        UsageError: names the first such feature.
    """
    _refuse_first(environment, _model_problems(environment, grid_model))


def _refuse_first(environment: Any, problems: Iterator[str]) -> None:
    for problem in problems:
        raise UsageError(f"Environment {environment_name(environment)} cannot be compiled: {problem}.")


def _environment_problems(environment: Any) -> Iterator[str]:
    yield from _backend_problems(environment.backend)
    yield from _parameter_problems(environment)
    yield from _rule_problems(environment)
    yield from _size_problems(environment)
    yield from _opponent_problems(environment._oppSpace)
    yield from _series_problems(environment)


def _backend_problems(backend: Any) -> Iterator[str]:
    if not isinstance(backend, LightSimBackend):
        yield f"its backend is {type(backend).__name__}, only LightSimBackend is simulated"
    if backend._dist_slack_non_renew:
        yield "its backend distributes the slack (dist_slack_non_renew), only a single slack generator is simulated"
    if not backend._turned_off_pv:
        yield "its backend lets idle generators float (turned_off_pv=False), only turned_off_pv=True is simulated"
    if not backend.initdc:
        yield "its backend does not start from a DC flow (initdc=False), only initdc=True is simulated"
    algorithm = backend._grid.get_algo_type().name
    if not algorithm.startswith("NR"):
        yield f"its power flow algorithm is {algorithm}, only those of Newton-Raphson (NR...) are simulated"


def _parameter_problems(environment: Any) -> Iterator[str]:
    parameters = environment._parameters
    for name, simulated in PARAMETERS.items():
        value = getattr(parameters, name)
        if value != simulated:
            yield f"parameter {name} is {value}, only {simulated} is simulated"
    for name in ("MAX_SUB_CHANGED", "MAX_LINE_STATUS_CHANGED"):
        if getattr(parameters, name) < 1:
            yield f"parameter {name} is {getattr(parameters, name)}, only 1 and more are simulated"
    forecast = getattr(environment._observation_space, "obs_env", None)
    for name in (*PARAMETERS, *FREE_PARAMETERS):
        if forecast is not None and getattr(forecast._parameters, name) != getattr(parameters, name):
            yield f"parameter {name} of its forecasts differs from its own, only the same value is simulated"


def _rule_problems(environment: Any) -> Iterator[str]:
    rules = type(environment._game_rules.legal_action)
    if rules not in (DefaultRules, RulesByArea):
        yield f"its rules are {rules.__name__}, only DefaultRules and RulesByArea are simulated"
    solver = type(environment._redispatch_solver)
    if solver not in (DefaultRedispatchSolver, ExactRedispatchSolver):
        yield f"its redispatch_solver is {solver.__name__}, only Grid2Op's default one is simulated"
    if (environment._tol_poly, environment._epsilon_poly) != (TOLERANCE, EPSILON):
        yield f"its tol_poly and epsilon_poly must be {TOLERANCE:g} and {EPSILON:g} MW"
    controller = type(environment._voltage_controler)
    if controller is not ControlVoltageFromFile:
        yield f"its voltage controller is {controller.__name__}, only ControlVoltageFromFile is simulated"


def _size_problems(environment: Any) -> Iterator[str]:
    kind = type(environment)
    if kind.n_busbar_per_sub != 2:
        yield f"its substations have {kind.n_busbar_per_sub} busbars, only 2 are simulated"
    if kind.detachment_is_allowed:
        yield "loads and generators may be detached (allow_detachment), which is not simulated"
    if not kind.redispatching_unit_commitment_availble:
        yield "its generators have no limits and costs (prods_charac.csv), without which no dispatch is simulated"
    unknowns, entries = 4 * kind.n_sub, 2 * kind.n_sub + 2 * kind.n_line
    if max(unknowns, entries) > LARGEST_INDEX:
        yield (
            f"it has {kind.n_sub:,} substations and {kind.n_line:,} lines, only up to {LARGEST_INDEX // 4:,} "
            f"substations are simulated, and up to {LARGEST_INDEX // 2:,} of both together"
        )
    seconds = 3600 / STEPS_PER_HOUR
    if environment.delta_time_seconds != seconds:
        yield f"its time step is {environment.delta_time_seconds:g} s, only {seconds:g} s is simulated"


def _opponent_problems(space: Any) -> Iterator[str]:
    name = type(space.opponent).__name__
    if OPPONENT_KINDS.get(name) is None:
        yield f"its opponent is {name}, only {', '.join(OPPONENT_KINDS)} are simulated"
    budget = type(space.compute_budget)
    if name != "BaseOpponent" and budget is not BaseActionBudget:
        yield f"the budget of its opponent is {budget.__name__}, only BaseActionBudget is simulated"


def _series_problems(environment: Any) -> Iterator[str]:
    hazards = getattr(read_series(environment), "hazards", None)
    if hazards is not None and np.any(hazards):
        yield "its time series have hazards, which are not simulated"
    first_action = environment.chronics_handler.get_init_action(environment._names_chronics_to_backend)
    if first_action is not None or environment._init_obs is not None:
        yield "its episodes begin with a topology of their own, only all elements on busbar 1 are simulated"


def _model_problems(environment: Any, model: Any) -> Iterator[str]:
    kinds = {
        "static generators": model.get_static_generators(),
        "HVDC lines": model.get_dclines(),
        "static VAR compensators": model.get_svcs(),
    }
    for kind, elements in kinds.items():
        if len(list(elements)):
            yield f"its grid has {kind}, which are not simulated"
    yield from _place_problems(environment, model)
    generators = list(model.get_generators())
    n_slack = sum(generator.is_slack for generator in generators)
    if n_slack != 1:
        yield f"{n_slack} generators share the slack, only a single one is simulated"
    for generator in generators:
        if not generator.voltage_regulator_on or generator.regulated_bus_id != generator.bus_id:
            yield f"generator {generator.id} does not regulate the voltage of its own bus, only such are simulated"
    for line in (*model.get_lines(), *model.get_trafos()):
        mutual = np.array([line.yac_12, line.ydc_11, line.ydc_22, -line.ydc_12])
        if not np.allclose(mutual, [line.yac_21, *[-line.ydc_21] * 3], rtol=1e-12, atol=0.0):
            yield f"transformer {line.id} shifts the phase, which is not simulated"


def _place_problems(environment: Any, model: Any) -> Iterator[str]:
    """Whether each element is in service where Grid2Op has it, on busbar 1 of its substation."""
    branches = [*model.get_lines(), *model.get_trafos()]
    places = {
        "lines": ([(line.bus1_id, line.bus2_id) for line in branches], _pairs(environment)),
        "generators": ([generator.bus_id for generator in model.get_generators()], environment.gen_to_subid),
        "loads": ([load.bus_id for load in model.get_loads()], environment.load_to_subid),
        "storage units": ([storage.bus_id for storage in model.get_storages()], environment.storage_to_subid),
    }
    if model.get_n_sub() != environment.n_sub or len(model.get_bus_vn_kv()) != 2 * environment.n_sub:
        yield "its electrical model has other substations than Grid2Op"
    for kind, (buses, substations) in places.items():
        if not np.array_equal(buses, substations):
            yield f"some of its {kind} begin out of service or on busbar 2, only all on busbar 1 are simulated"


def _pairs(environment: Any) -> Any:
    return np.stack((environment.line_or_to_subid, environment.line_ex_to_subid), axis=1)
