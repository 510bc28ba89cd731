"""Graphs beside a loop over the elements of the state they were observed in."""

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.graph import GraphBuilder, GraphObservation, VectorGraphObservation
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError

TOLERANCE = 1e-5
"""Relative, of sums in float64 over features that were divided and multiplied by their scale in float32."""
TASKS = ("bus14-T1", "bus36-MO-v0-T1", "bus118-MOB-v1-T0", "bus14-R", "bus36-MO-v0-R", "bus118-MOB-v1-R", "bus14-H1")


def act(env, random):
    if isinstance(env.action_space, gymnasium.spaces.Dict):
        values = random.uniform(-0.02, 0.02, env.unwrapped.task.n_injections).astype(np.float32)
        return {"topology": int(random.choice(np.flatnonzero(env.unwrapped.action_masks()))), "injection": values}
    if isinstance(env.action_space, gymnasium.spaces.Discrete):
        return int(random.choice(np.flatnonzero(env.unwrapped.action_masks())))
    return random.uniform(-0.02, 0.02, env.action_space.shape).astype(np.float32)


def slow_nodes(grid, state, names):
    """What each busbar has, element by element, in physical units: {(node, feature): value}."""
    value = np.zeros((2 * grid.n_sub, len(names)))
    angles, elements = [[] for _ in range(2 * grid.n_sub)], np.zeros(2 * grid.n_sub)
    topology = state.topo_vect[0]

    def node(position):
        return int(grid.element_to_subid[position]) + grid.n_sub * (int(topology[position]) - 1)

    def add(position, name, amount):
        if topology[position] > 0 and name in names:
            value[node(position), names.index(name)] += amount

    def note_angle(position, angle):
        if topology[position] > 0:
            angles[node(position)].append(float(angle))

    for gen, position in enumerate(grid.gen_pos_topo_vect):
        note_angle(position, state.gen_theta[0, gen])
        for name in ("gen_p", "target_dispatch", "actual_dispatch", "gen_margin_up", "gen_margin_down"):
            add(position, name, getattr(state, name)[0, gen])
        add(position, "gen_p_before_curtail", state.gen_p_before_curtail[0, gen])
        if grid.gen_renewable[gen]:
            add(position, "curtailment", state.curtailment[0, gen] * grid.gen_pmax[gen])
            add(position, "curtailment_limit", state.curtailment_limit[0, gen] * grid.gen_pmax[gen])
    for load, position in enumerate(grid.load_pos_topo_vect):
        note_angle(position, state.load_theta[0, load])
        add(position, "load_p", state.load_p[0, load])
    for unit, position in enumerate(grid.storage_pos_topo_vect):
        note_angle(position, state.storage_theta[0, unit])
        add(position, "storage_power", state.storage_power[0, unit])
        add(position, "storage_charge", state.storage_charge[0, unit])
    for position in range(grid.dim_topo):
        if topology[position] > 0:
            elements[node(position)] += 1
    for busbar in range(2 * grid.n_sub):
        value[busbar, names.index("theta")] = np.mean(angles[busbar]) if angles[busbar] else 0.0
        value[busbar, names.index("theta_observed")] = bool(angles[busbar])
        value[busbar, names.index("elements")] = elements[busbar] / grid.sub_info[busbar % grid.n_sub]
        if "time_before_cooldown_sub" in names:
            cooldown = state.time_before_cooldown_sub[0, busbar % grid.n_sub]
            value[busbar, names.index("time_before_cooldown_sub")] = cooldown
    return value, elements > 0


def assert_is_the_graph_of(graph, env):
    grid, state, builder = env.unwrapped.grid, env.unwrapped.state, env.builder
    nodes, in_use = slow_nodes(grid, state, builder.node_features)
    np.testing.assert_allclose(graph["nodes"], nodes, rtol=TOLERANCE, atol=1e-3)
    np.testing.assert_array_equal(graph["node_mask"], in_use)
    topology = state.topo_vect[0]
    for line in range(grid.n_line):
        ends = []
        for position in (grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]):
            busbar = max(int(topology[position]), 1) if state.line_status[0, line] else 1
            ends.append(int(grid.element_to_subid[position]) + grid.n_sub * (busbar - 1))
        for edge, expected in ((line, ends), (grid.n_line + line, ends[::-1])):
            assert graph["edge_mask"][edge] == state.line_status[0, line]
            assert graph["edge_index"][:, edge].tolist() == expected
            for column, name in enumerate(builder.edge_features[:-1]):
                assert graph["edges"][edge, column] == np.float32(getattr(state, name)[0, line])
            assert graph["edges"][edge, -1] == (edge < grid.n_line)


@pytest.mark.parametrize("task", TASKS)
def test_equals_a_loop_over_the_elements(task):
    env = GraphObservation(gymnasium.make(f"rl2grid/{task}-v0", normalize=None))
    random = np.random.default_rng(4)
    graph, _ = env.reset(seed=2)
    divided = opened = False
    for decision in range(3000):
        divided |= bool(graph["node_mask"][env.unwrapped.grid.n_sub :].any())
        opens = not graph["edge_mask"].all()
        if decision < 20 or (opens and not opened):
            assert env.observation_space.contains(graph)
            assert_is_the_graph_of(graph, env)
            state = env.unwrapped.state
            assert graph["nodes"][:, 0].sum() == pytest.approx(state.gen_p[0].sum(), rel=TOLERANCE, abs=1e-3)
            assert graph["nodes"][:, 1].sum() == pytest.approx(state.load_p[0].sum(), rel=TOLERANCE, abs=1e-3)
        opened |= opens
        if opened and decision >= 20:
            break
        # Left alone, a month of bus14-R sees a line out before it is lost.
        calm = task == "bus14-R" and decision >= 20
        action = np.zeros(env.action_space.shape, np.float32) if calm else act(env, random)
        graph, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            graph, _ = env.reset()
    assert divided != task.endswith("R")
    assert opened, "no line was out: the test did not see a mask"


@pytest.mark.parametrize("task", TASKS)
def test_physical_scaling_divides_by_constants_of_the_grid(task):
    graphs = {}
    for normalize in (None, "physical"):
        env = GraphObservation(gymnasium.make(f"rl2grid/{task}-v0", normalize=normalize))
        graphs[normalize], _ = env.reset(seed=1)
    grid, names = env.unwrapped.grid, env.builder.node_features
    raw, scaled = graphs[None]["nodes"], graphs["physical"]["nodes"]
    largest = grid.gen_pmax.max()
    np.testing.assert_allclose(scaled[:, :4] * largest, raw[:, :4], rtol=TOLERANCE, atol=1e-3)
    theta = names.index("theta")
    np.testing.assert_allclose(scaled[:, theta] * 180, raw[:, theta], rtol=TOLERANCE, atol=1e-3)
    np.testing.assert_array_equal(scaled[:, theta + 1 : theta + 3], raw[:, theta + 1 : theta + 3])
    for name in ("node_mask", "edge_index", "edge_mask", "t"):
        np.testing.assert_array_equal(graphs[None][name], graphs["physical"][name])


@pytest.mark.parametrize("task", ["bus14-T0", "bus118-MOB-v1-R"])
def test_graphs_of_a_vector_are_those_of_its_observations(task):
    plain, graphs = (gymnasium.make_vec(f"rl2grid/{task}-v0", num_envs=3) for _ in range(2))
    wrapped, builder = VectorGraphObservation(graphs), GraphBuilder(find_task(task))
    observations, _ = plain.reset(seed=1)
    mine, _ = wrapped.reset(seed=1)
    plain.action_space.seed(2)
    endings = 0
    for _ in range(40):
        assert wrapped.observation_space.contains(mine)
        for i, observation in enumerate(observations):
            for name, array in builder.graph(observation).items():
                np.testing.assert_array_equal(mine[name][i], array)
        actions = plain.action_space.sample()
        observations, *_, infos = plain.step(actions)
        mine, *_, wrapped_infos = wrapped.step(actions)
        for i in np.flatnonzero(infos.get("_final_obs", [])):
            endings += 1
            for name, array in builder.graph(infos["final_obs"][i]).items():
                np.testing.assert_array_equal(wrapped_infos["final_obs"][i][name], array)
    assert endings


@pytest.mark.parametrize("task", ["bus14-T0", "bus14-R"])
def test_a_game_over_uses_no_busbar_and_no_line(task):
    env = GraphObservation(gymnasium.make(f"rl2grid/{task}-v0"))
    env.reset(seed=0)
    random = np.random.default_rng(0)
    for _ in range(2000):
        graph, _, terminated, truncated, _ = env.step(
            env.action_space.sample() if task[-1] == "R" else act(env, random)
        )
        if terminated or truncated:
            break
    assert terminated
    assert not graph["node_mask"].any()
    assert not graph["edge_mask"].any()


def test_observations_that_another_wrapper_changed_are_refused():
    env = gymnasium.make("rl2grid/bus14-T0-v0")
    with pytest.raises(UsageError, match="wrap the task before"):
        GraphObservation(gymnasium.wrappers.ReshapeObservation(env, (1, *env.observation_space.shape)))
    with pytest.raises(UsageError, match="no task of rl2grid"):
        GraphObservation(gymnasium.make("CartPole-v1"))
