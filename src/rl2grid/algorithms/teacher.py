"""What keeps a learner near the policy that it began with, its teacher, until it has learned what the teacher is worth.

As long as its coefficient c is above 0, the policy pi minimises beside everything else

    c KL(teacher || pi), the mean over the states played

where c falls linearly from ``teacher_coefficient`` to 0 over the share ``teacher_fraction`` of the run. The divergence
is exact: that of two categorical distributions over the legal actions, or of two diagonal Gaussians (where policies are
squashed, those before squashing, which changes nothing).
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from rl2grid.algorithms.hyperparameters import SharedArgs, added_later
from rl2grid.errors import UsageError

COEFFICIENT = 1.0
"""Of a learner that begins with the policy of another run, unless another one is asked for."""


@dataclass(frozen=True)
class TeacherArgs(SharedArgs):
    """Hyperparameters of algorithms that stay near the policy that they begin with."""

    teacher_coefficient: float | None = added_later(None)
    """Weight at the beginning of what keeps the policy near that of ``start_from``; None: 1 if there is one, else 0."""
    teacher_fraction: float = added_later(0.5)
    """Share of the run over which that weight falls to zero, linearly."""
    actor_starts: int | None = added_later(None)
    """Decisions before the policy is changed, while critics learn already; None: what the algorithm needs."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; see :class:`SharedArgs`."""
        super().__post_init__()
        self._check_shares("teacher_fraction")
        if self.teacher_coefficient is not None:
            self._check_not_negative("teacher_coefficient")
        if self.actor_starts is not None:
            self._check_not_negative("actor_starts")
            if self.actor_starts >= self.total_timesteps:
                raise UsageError(
                    f"{self.algorithm} needs actor_starts below total_timesteps (--decisions), {self.total_timesteps}, "
                    f"not {self.actor_starts}: the policy would never be changed."
                )

    def teacher_coefficient_at(self, decisions: int) -> float:
        """The weight after so many decisions, of a run that has a teacher."""
        first = COEFFICIENT if self.teacher_coefficient is None else self.teacher_coefficient
        span = self.teacher_fraction * self.total_timesteps
        return first * max(1.0 - decisions / span, 0.0) if span else 0.0


def divergences(teacher: tuple[Tensor, ...], pupil: tuple[Tensor, ...]) -> Tensor:
    """KL(teacher || pupil) [batch] of log-probabilities alone, or of means and log standard deviations."""
    if len(teacher) == 1:
        return categorical_divergences(*teacher, *pupil)
    return gaussian_divergences((teacher[0], teacher[1]), (pupil[0], pupil[1]))


def categorical_divergences(teacher: Tensor, pupil: Tensor) -> Tensor:
    """KL(teacher || pupil) of log-probabilities [batch, actions], [batch]; illegal actions have one that is finite."""
    return (teacher.exp() * (teacher - pupil)).sum(dim=-1)


def gaussian_divergences(teacher: tuple[Tensor, Tensor], pupil: tuple[Tensor, Tensor]) -> Tensor:
    """KL(teacher || pupil) of means and log standard deviations [batch, dimensions] or [dimensions], [batch]."""
    (means, log_stds), (its_means, its_log_stds) = teacher, pupil
    squares = (2.0 * log_stds).exp() + (means - its_means).square()
    return (its_log_stds - log_stds + 0.5 * squares / (2.0 * its_log_stds).exp() - 0.5).sum(dim=-1)
