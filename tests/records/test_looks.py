"""What the order of a ledger says of its results."""

from __future__ import annotations

from typing import Any

from rl2grid.records.evaluations import identity_hash
from rl2grid.records.ledger import HashedTest
from rl2grid.records.looks import budget, earlier_choices, is_outdated, latest_rules, looks, method_of

TASK = "rl2grid/bus14-T0-v0"


def entry(seed: int, learning_rate: float = 0.1, version: str = "2", **configuration: Any) -> HashedTest:
    chosen = {
        "algorithm": "ppo",
        "task": TASK,
        "hyperparameters": {"total_timesteps": 1000, "seed": seed, "learning_rate": learning_rate},
    }
    chosen |= {"env_keywords": {"heuristic": "idle"}, "test": {"split_version": version, "months": 500}}
    training = {"identity": {"budget": {"decisions": 1000, "evaluate_every": 250, "validation_months": 20}}}
    months = {"split": "test", "split_version": version, "generator_version": "1", "number": 500, "seeds": 1}
    return HashedTest({**chosen, **configuration}, training, "", "", {}, months, {}, {})


def ledger(*results: HashedTest) -> dict[str, HashedTest]:
    return {identity_hash(one.configuration): one for one in results}


def test_seeds_of_one_configuration_are_one_look():
    results = ledger(entry(1), entry(2), entry(1, 0.2), entry(3), entry(1, version="1"))
    assert looks(results, "bus14", "2") == [entry(1).choice, entry(1, 0.2).choice]
    assert len(looks(results, "bus14", "1")) == 1
    assert looks(results, "bus118-M", "2") == []


def test_what_came_after_another_choice_of_its_method_is_known():
    later, other = entry(1, 0.2), entry(1, env_keywords={"heuristic": "recovery"})
    results = ledger(entry(1), entry(2), other, later, entry(2, 0.2))
    assert earlier_choices(results, method_of(entry(1)), entry(1).choice) == []
    assert earlier_choices(results, method_of(later), later.choice) == [entry(1).choice]
    assert earlier_choices(results, method_of(other), other.choice) == []
    new = entry(1, 0.3)
    assert earlier_choices(results, method_of(new), new.choice) == [entry(1).choice, later.choice]
    fresh = entry(1, 0.3, version="3")
    assert earlier_choices(results, method_of(fresh), fresh.choice) == []


def test_a_budget_is_decisions_and_validations():
    assert budget(entry(1)) == (("decisions", 1000), ("evaluate_every", 250), ("validation_months", 20))
    assert budget(HashedTest({"agent": "greedy", "task": TASK, "heuristic": None}, {}, "", "", {}, {}, {}, {})) == ()


def untrained(heuristic: str | None, **rules: int) -> HashedTest:
    configuration = {"agent": "planner", "task": "rl2grid/bus14-R-v0", "heuristic": heuristic, **rules}
    return HashedTest(configuration, {}, "", "", {}, {"split_version": "2"}, {}, {})


def test_rules_of_an_agent_outdate_all_its_tests_and_those_of_a_heuristic_the_tests_with_it():
    old, with_other, latest = untrained("secure"), untrained("recovery"), untrained("secure", heuristic_rules=2)
    results = ledger(old, with_other, latest)
    assert [is_outdated(one, latest_rules(results)) for one in (old, with_other, latest)] == [True, False, False]
    results = ledger(old, with_other, latest, untrained("idle", rules=2))
    assert all(is_outdated(one, latest_rules(results)) for one in (old, with_other, latest))
