"""A grid that takes microseconds: ``gymnasium.make("fake_grid:FakeGrid-v0")`` plays it by the rules of the real ones.

A load of stress builds up, action 1 lowers it, the grid is lost above 1. Every grid step pays 1, costs
0.25 in the third component and 0.5 of TLO cost. Scenarios whose name contains "doomed" are lost inside
``reset`` under a heuristic. An episode is a function of scenario, start, seed and actions.
"""

from __future__ import annotations

import time
import zlib
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np

from rl2grid.envs.operation import Operation
from rl2grid.errors import UsageError
from rl2grid.mdp.termination import GameOver

LENGTH = 60
N_LINES = 3


class FakeGrid(gymnasium.Env[Any, Any]):
    """See the module; ``log`` names a file that notes every reset, ``fail_on`` a scenario that raises."""

    imagined, foresight = False, 0

    def __init__(
        self,
        *,
        heuristic: str | None = None,
        split: str = "validation",
        log: str | None = None,
        fail_on: str | None = None,
        exit_on: str | None = None,
        delay: float = 0.0,
    ) -> None:
        if heuristic not in (None, "idle"):
            raise UsageError(f"Heuristic {heuristic!r} does not exist: choose None or idle.")
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(4)
        self.step_listeners: list[Any] = []
        self.task = SimpleNamespace(id="fake")
        self.grid = SimpleNamespace(name_line=tuple(f"line {k}" for k in range(N_LINES)), n_line=N_LINES)
        self.options = SimpleNamespace(heuristic=heuristic, engine="fake")
        self._log, self._fail_on, self._exit_on, self._delay = log, fail_on, exit_on, delay

    @property
    def state(self) -> SimpleNamespace:
        return self._state

    def action_masks(self) -> np.ndarray[Any, Any]:
        return np.array([True, True, self._stress < 0.3, False])

    def operation(self) -> Operation:
        return Operation(2.0 * self._step, 0.0, 0.0, 0.0, 100.0 * (LENGTH - self._step) * self._lost(), 0.0, 0.0, 0.0)

    def clock_at(self, step: int) -> datetime:
        return datetime(2020, 4, 1) + step * timedelta(minutes=5)

    def describe_action(self, action: Any) -> str:
        return f"action {int(action)}"

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        assert seed is not None
        assert options is not None
        self._scenario, self._start = options["scenario"], options["start"]
        if self._log is not None:
            with Path(self._log).open("a") as file:
                file.write(f"{self._scenario} {seed % 2**31}\n")
        if self._scenario == self._fail_on:
            raise ValueError("the fake grid was told to fail")
        if self._scenario == self._exit_on:
            raise SystemExit(3)
        self._random = np.random.Generator(np.random.Philox(key=[seed % 2**31, zlib.crc32(self._scenario.encode())]))
        self._stress = 0.6 if "doomed" in self._scenario else 0.0
        self._step = 0
        self._state = SimpleNamespace(
            rho=np.zeros((1, N_LINES), np.float32),
            line_status=np.ones((1, N_LINES), np.bool_),
            attacked=np.zeros((1, N_LINES), np.bool_),
            time_next_maintenance=np.full((1, N_LINES), -1, np.int32),
            topo_vect=np.ones((1, 2 * N_LINES), np.int32),
            gen_p=np.zeros((1, 1), np.float32),
            load_p=np.zeros((1, 1), np.float32),
            storage_power=np.zeros((1, 0), np.float32),
            p_or=np.zeros((1, N_LINES), np.float32),
            gen_p_before_curtail=np.zeros((1, 1), np.float32),
            step=np.zeros(1, np.int32),
            episode_length=np.full(1, LENGTH, np.int32),
            terminated=np.zeros(1, np.bool_),
            final_topo_vect=np.ones((1, 2 + 2 * N_LINES), np.int32),
            line_or_pos_topo_vect=np.arange(1, 1 + N_LINES),
            line_ex_pos_topo_vect=np.arange(2 + N_LINES, 2 + 2 * N_LINES),
            gen_pos_topo_vect=np.array([0]),
            load_pos_topo_vect=np.array([1 + N_LINES]),
            element_to_subid=np.repeat([0, 1], 1 + N_LINES),
            sub_info=np.full(2, 1 + N_LINES),
            slack_gen=np.array([0]),
        )
        self._steps = 0
        self._announce()
        self._heuristic()
        self._reset_steps, self._steps = self._steps, 0
        self._over = self._ended()
        return self._observation(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._over:
            self._over = False
        else:
            assert not self._ended(), "an ended episode was stepped"
            assert self.action_masks()[int(action)], "an illegal action was played"
            self._steps = 0
            self._stress = max(0.0, self._stress - (0.25 if action == 1 else 0.0))
            self._advance()
            self._heuristic()
        return self._observation(), float(self._steps) * 0.75, self._lost(), self._completed(), self._info()

    def _heuristic(self) -> None:
        while self.options.heuristic and not self._ended() and (self._stress < 0.4 or "doomed" in self._scenario):
            self._advance()

    def _advance(self) -> None:
        time.sleep(self._delay)
        self._stress += float(self._random.uniform(0.0, 0.2))
        self._step += 1
        self._steps += 1
        self._announce()

    def _announce(self) -> None:
        state = self._state
        state.rho[0] = self._stress * np.arange(1, N_LINES + 1)
        state.step[0], state.terminated[0] = self._step, self._lost()
        for listener in self.step_listeners:
            listener(state, 0)

    def _lost(self) -> bool:
        return self._stress > 1.0

    def _completed(self) -> bool:
        return self._step >= LENGTH and not self._lost()

    def _ended(self) -> bool:
        return self._lost() or self._completed()

    def _observation(self) -> np.ndarray[Any, Any]:
        return np.array([self._step / LENGTH, self._stress], np.float32)

    def _info(self) -> dict[str, Any]:
        steps, before = self._steps, self._reset_steps
        lost = 2.0 * self._lost()
        return {
            "scenario": self._scenario,
            "start": self._start,
            "start_redraws": 0,
            "step": self._step,
            "episode_length": LENGTH,
            "survival": (self._step - self._lost()) / LENGTH,
            "n_steps": steps,
            "reward_components": {"survive": 1.0 * steps, "overload": 0.0, "cost": -0.25 * steps},
            "costs": {"LSI": lost * (steps > 0), "TLO": 0.5 * steps},
            "reset_reward": 0.75 * before,
            "reset_components": {"survive": 1.0 * before, "overload": 0.0, "cost": -0.25 * before},
            "reset_costs": {"LSI": lost * (steps == 0), "TLO": 0.5 * before},
            "scores": {"margin": 1.5, "overload": -0.5, "topology": -2.0},
            "illegal": False,
            "ambiguous": steps > 30,
            "game_over": int(GameOver.DIVERGENCE) if self._lost() else 0,
            "over": self._over,
        }


gymnasium.register(id="FakeGrid-v0", entry_point=FakeGrid)
