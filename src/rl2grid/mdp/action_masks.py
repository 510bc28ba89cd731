"""Which actions of a catalogue are legal, in many environments at once."""

from __future__ import annotations

from rl2grid.arrays import I8, I32, I64, Flags
from rl2grid.compile import jit
from rl2grid.mdp.actions import is_legal
from rl2grid.mdp.state_handles import open_state


@jit
def write_action_masks(address: int, first: I64, kind: I8, target: I32, out: Flags) -> None:
    """Write :func:`~rl2grid.mdp.actions.legal_actions` of all environments to ``out``, bool [n, action].

    Args:
        address: of a handle to the state of ``n`` environments.
        first: where runs begin, int64 [run + 1]; see :attr:`rl2grid.mdp.actions.ActionCatalogue.runs`.
        kind: of the actions, int8 [action].
        target: of the actions, int32 [action].
        out: the masks.
    """
    state = open_state(address)
    for i in range(out.shape[0]):
        mask = out[i]
        for run in range(first.shape[0] - 1):
            begin, end = first[run], first[run + 1]
            legal = is_legal(state, i, kind[begin], target[begin])
            mask[begin] = legal
            for action in range(begin + 1, end):
                mask[action] = legal
