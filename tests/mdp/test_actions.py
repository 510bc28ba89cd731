"""Actions against live Grid2Op: same catalogue, same order, same verdict on every action."""

import itertools
import time
import warnings

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import (
    DO_NOTHING,
    ActionKind,
    action_set_hash,
    continuous_layout,
    decode_continuous,
    describe,
    full_catalogue,
    inject,
    is_legal,
    legal_actions,
    level_catalogue,
    level_ids,
    moved_elements,
    reconnect,
    restore,
)
from rl2grid.mdp.state import new_state

CATALOGUE_SIZES = dict(zip(GRID_IDS, (209, 66_978, 66_978, 66_978, 72_461, 73_328, 73_357), strict=True))


@pytest.fixture(scope="module")
def make_env():
    """Builds live Grid2Op environments, each once."""
    import grid2op
    from grid2op.Action import PlayableAction
    from lightsim2grid import LightSimBackend

    made = {}

    def make(name):
        if name not in made:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                made[name] = grid2op.make(name, test=True, backend=LightSimBackend(), action_class=PlayableAction)
        return made[name]

    yield make
    for env in made.values():
        env.close()


def grid2op_action(env, grid, action):
    """The Grid2Op action that ``action`` stands for."""
    if not action.changes:
        return env.action_space({})
    ((kind, target, mask),) = action.changes
    if kind == ActionKind.SWITCH:
        return env.action_space({"change_line_status": [target]})
    if kind == ActionKind.RECONNECT:
        return env.action_space({"set_line_status": [(target, 1)]})
    change = np.zeros(grid.dim_topo, bool)
    change[moved_elements(grid, target, mask)] = True
    return env.action_space({"change_bus": change})


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_the_catalogue_has_the_sizes_of_the_paper(grid_id):
    grid = load_grid(grid_id)
    assert len(full_catalogue(grid)) == CATALOGUE_SIZES[grid_id] == grid.level_sizes[-1]


def test_building_the_largest_catalogue_is_fast():
    grid = load_grid("bus118-MOB-v1")
    begin = time.perf_counter()
    full_catalogue.__wrapped__(grid)
    assert time.process_time() - begin < 0.1


def test_bus14_is_the_discrete_action_space_of_grid2op(make_env):
    from grid2op.gym_compat import DiscreteActSpace

    env, grid = make_env("l2rpn_case14_sandbox"), load_grid("bus14")
    space = DiscreteActSpace(env.action_space, attr_to_keep=["change_bus", "change_line_status"])
    catalogue = full_catalogue(grid)
    assert space.n == len(catalogue)
    for action in range(len(catalogue)):
        ours = grid2op_action(env, grid, catalogue[action])
        np.testing.assert_array_equal(ours.to_vect(), space.from_gym(action).to_vect(), str(action))


@pytest.mark.parametrize("grid_id", ["bus36-MO-v0", "bus118-MOB-v1"])
def test_moves_follow_grid2ops_order(make_env, grid_id):
    grid = load_grid(grid_id)
    env = make_env(grid.bundled_names[0])
    catalogue = full_catalogue(grid)
    for sub in np.flatnonzero(grid.sub_info <= 6)[::3]:
        ours = np.flatnonzero((catalogue.kind == ActionKind.MOVE) & (catalogue.target == sub))
        theirs = env.action_space.get_all_unitary_topologies_change(env.action_space, sub_id=sub)
        assert len(ours) == len(theirs)
        for action, expected in zip(ours, theirs, strict=True):
            assert grid2op_action(env, grid, catalogue[action]) == expected


def test_the_largest_substation_counts_in_lexicographic_order():
    grid = load_grid("bus36-M")
    sub = int(grid.sub_info.argmax())
    n = int(grid.sub_info[sub])
    catalogue = full_catalogue(grid)
    masks = catalogue.mask[:, 0][(catalogue.kind == ActionKind.MOVE) & (catalogue.target == sub)]
    assert len(masks) == 2 ** (n - 1) - 1
    vectors = itertools.islice(itertools.product((0, 1), repeat=n - 1), 1, 5000)
    for mask, vector in zip(masks, vectors, strict=False):
        assert [int(mask) >> k & 1 for k in range(n)] == [0, *vector]


def test_the_catalogue_can_not_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        full_catalogue(load_grid("bus14")).mask[3] = 1


def observe(state, observation):
    state.time_before_cooldown_line[0] = observation.time_before_cooldown_line
    state.time_before_cooldown_sub[0] = observation.time_before_cooldown_sub


def test_every_bus14_action_is_legal_where_grid2op_accepts_it(make_env):
    """Play at random with cooldowns of 3 steps and ask Grid2Op's rules about all 209 actions."""
    env, grid = make_env("l2rpn_case14_sandbox"), load_grid("bus14")
    parameters = env.parameters
    parameters.NB_TIMESTEP_COOLDOWN_LINE = parameters.NB_TIMESTEP_COOLDOWN_SUB = 3
    env.change_parameters(parameters)
    seen = check_random_play(env, grid, steps=40, tried=np.arange(209), seed=0)
    assert seen > 100


@pytest.mark.parametrize("grid_id", ["bus36-MO-v0", "bus118-MOB-v1"])
def test_sampled_actions_are_legal_where_grid2op_accepts_them(make_env, grid_id):
    grid = load_grid(grid_id)
    rng = np.random.default_rng(5)
    moves = rng.choice(len(full_catalogue(grid)), 60)
    switches = len(full_catalogue(grid)) - grid.n_line + np.arange(grid.n_line)
    small = np.flatnonzero(grid.sub_info <= 5)[:12]
    at_small = np.flatnonzero(np.isin(full_catalogue(grid).target, small) & (full_catalogue(grid).kind == 1))[::3]
    tried = np.concatenate((moves, switches, at_small))
    assert check_random_play(make_env(grid.bundled_names[0]), grid, steps=25, tried=tried, seed=1) > 50


def test_a_run_of_the_full_catalogue_is_a_substation_or_a_line():
    grid = load_grid("bus36-M")
    movable = np.count_nonzero(grid.sub_info > 1)
    assert len(full_catalogue(grid).runs) - 1 == 1 + movable + grid.n_line
    assert full_catalogue(grid).runs[-1] == len(full_catalogue(grid))


def check_random_play(env, grid, steps, tried, seed):
    """Compare verdicts over random legal play; returns how many illegal actions were met."""
    rng = np.random.default_rng(seed)
    catalogue = full_catalogue(grid)
    state, legal = new_state(grid, 1), np.zeros(len(tried), bool)
    kind, target = catalogue.kind[tried], catalogue.target[tried]
    observation = env.reset(seed=seed)
    n_illegal = 0
    for _ in range(steps):
        observe(state, observation)
        legal_actions(state, 0, kind, target, legal)
        for action, ours in zip(tried, legal, strict=True):
            played = grid2op_action(env, grid, catalogue[action])
            assert not played.is_ambiguous()[0]
            accepted, _ = env._game_rules(action=played, env=env)
            assert accepted == ours, (describe(grid, catalogue[action]), accepted)
        for line in np.flatnonzero(~observation.line_status):
            accepted, _ = env._game_rules(action=grid2op_action(env, grid, reconnect(int(line))), env=env)
            assert accepted == is_legal(state, 0, int(ActionKind.RECONNECT), int(line))
        n_illegal += int((~legal).sum())
        choice = int(rng.choice(np.flatnonzero(legal)))
        observation, _, done, info = env.step(grid2op_action(env, grid, catalogue[tried[choice]]))
        assert not info["is_illegal"]
        assert not info["is_ambiguous"]
        if done:
            observation = env.reset()
    return n_illegal


@pytest.mark.parametrize("kind", [ActionKind.MOVE, ActionKind.RESTORE, ActionKind.SWITCH, ActionKind.RECONNECT])
def test_only_the_own_cooldown_counts(kind):
    state = new_state(load_grid("bus14"), 2)
    is_sub = kind in (ActionKind.MOVE, ActionKind.RESTORE)
    own = state.time_before_cooldown_sub if is_sub else state.time_before_cooldown_line
    other = state.time_before_cooldown_line if is_sub else state.time_before_cooldown_sub
    other[:] = 5
    own[1, 3] = 1
    assert is_legal(state, 1, int(kind), 4)
    assert not is_legal(state, 1, int(kind), 3)
    assert is_legal(state, 0, int(kind), 3)
    assert is_legal(state, 1, int(ActionKind.NOTHING), 3)


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_levels_begin_with_do_nothing_and_have_the_sizes_of_the_paper(grid_id):
    grid = load_grid(grid_id)
    for level, size in enumerate(grid.level_sizes):
        ids = level_ids(grid, level)
        assert ids.dtype == np.int32
        assert len(ids) == len(set(ids.tolist())) == size
        assert ids[0] == 0
        assert level_catalogue(grid, level)[0] == DO_NOTHING
    lower = [level_ids(grid, level) for level in range(len(grid.level_sizes) - 1)]
    for small, large in itertools.pairwise(lower):
        np.testing.assert_array_equal(large[: len(small)], small)
    np.testing.assert_array_equal(level_ids(grid, len(grid.level_sizes) - 1), np.arange(grid.level_sizes[-1]))


@pytest.mark.parametrize("level", [2, -1, "0", 1.0, True, None])
def test_a_level_that_does_not_exist_is_refused(level):
    with pytest.raises(UsageError, match=r"Level .* of bus14 .* 0 \(50 actions\), 1 \(209 actions\)"):
        level_ids(load_grid("bus14"), level)


def test_the_hash_tells_action_sets_apart():
    hashes = {action_set_hash(load_grid(grid_id), level) for grid_id in GRID_IDS for level in (0, 1)}
    assert len(hashes) == 14


def test_descriptions():
    grid = load_grid("bus14")
    catalogue = full_catalogue(grid)
    assert describe(grid, catalogue[0]) == "do nothing"
    assert describe(grid, catalogue[190]) == "switch line 1 (0_4_1)"
    assert describe(grid, catalogue[1]) == "substation 0: move generator 5 to the other busbar"
    assert describe(grid, catalogue[50]) == "substation 3: move line 6 with load 2 to the other busbar"
    assert describe(grid, catalogue[160]) == "substation 8: move lines 16 and 19 to the other busbar"
    assert describe(grid, reconnect(7)) == f"reconnect line 7 ({grid.name_line[7]})"
    assert describe(grid, restore(4)) == "substation 4: move everything back to busbar 1"
    values = np.array([0.5, 0, 0, -0.25, 0, 0], np.float32)
    injection = describe(grid, inject(values))
    gen = grid.name_gen[continuous_layout(grid).curtail[0]]
    assert injection.startswith("redispatch gen_1_0 by +2.5 MW; limit ")
    assert injection.endswith(f"limit {gen} to 75% of its maximum")
    assert describe(grid, inject(np.zeros(6, np.float32))) == "do nothing"


def test_every_description_is_different():
    grid = load_grid("bus14")
    catalogue = full_catalogue(grid)
    assert len({describe(grid, catalogue[k]) for k in range(len(catalogue))}) == 209


@pytest.mark.parametrize(("grid_id", "size"), list(zip(GRID_IDS, (6, 22, 22, 22, 62, 69, 69), strict=True)))
def test_continuous_actions_have_the_contracts_sizes(grid_id, size):
    layout = continuous_layout(load_grid(grid_id))
    assert layout.size == size == len(layout.names) == len(set(layout.names))


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_zero_is_no_intervention(grid_id):
    grid = load_grid(grid_id)
    injection = decode_continuous(grid, np.zeros(continuous_layout(grid).size))
    assert not injection.redispatch.any()
    assert not injection.storage.any()
    np.testing.assert_array_equal(injection.curtailment_limit, np.where(grid.gen_renewable, 1.0, -1.0))


def test_corners_are_ramps_limits_and_powers():
    grid = load_grid("bus118-MOB-v1")
    layout = continuous_layout(grid)
    up, down = (decode_continuous(grid, np.full(layout.size, sign)) for sign in (1.0, -1.0))
    np.testing.assert_array_equal(up.redispatch, np.where(grid.gen_redispatchable, grid.gen_max_ramp_up, 0))
    np.testing.assert_array_equal(down.redispatch, np.where(grid.gen_redispatchable, -grid.gen_max_ramp_down, 0))
    np.testing.assert_array_equal(up.curtailment_limit, np.where(grid.gen_renewable, 1, -1))
    np.testing.assert_array_equal(down.curtailment_limit, np.where(grid.gen_renewable, 0, -1))
    np.testing.assert_array_equal(up.storage, grid.storage_max_p_absorb)
    np.testing.assert_array_equal(down.storage, -grid.storage_max_p_prod)
    assert {array.dtype for array in (*up, *down)} == {np.dtype(np.float32)}


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-MOB-v1"])
def test_random_continuous_actions_are_unambiguous(make_env, grid_id):
    grid = load_grid(grid_id)
    env, rng = make_env(grid.bundled_names[0]), np.random.default_rng(0)
    for trial in range(20):
        values = rng.uniform(-1, 1, continuous_layout(grid).size)
        injection = decode_continuous(grid, np.sign(values) if trial % 2 else values)
        parts = {"redispatch": injection.redispatch, "curtail": injection.curtailment_limit}
        if grid.n_storage:
            parts["set_storage"] = injection.storage
        ambiguous, reason = env.action_space(parts).is_ambiguous()
        assert not ambiguous, reason


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(5), r"shape \(6,\), got \(5,\)"),
        (np.zeros((1, 6)), r"shape \(6,\), got \(1, 6\)"),
        (0.0, r"shape \(6,\), got \(\)"),
        ([0, 0, np.nan, 0, 0, 0], r"Entry 2 .* NaN"),
        ([0, 0, 0, 0, 1.5, 0], r"Entry 4 .* 1\.5: .* \[-1, 1\]"),
        ([0, -np.inf, 0, 0, 0, 0], r"Entry 1 .* -inf"),
        (["a"] * 6, r"6 numbers in \[-1, 1\]"),
        (None, r"shape \(6,\), got \(\)"),
    ],
)
def test_a_bad_continuous_action_is_refused(action, message):
    with pytest.raises(UsageError, match=message):
        decode_continuous(load_grid("bus14"), action)


def test_tiny_excess_from_double_precision_is_accepted():
    decode_continuous(load_grid("bus14"), np.full(6, 1 + 1e-12))
