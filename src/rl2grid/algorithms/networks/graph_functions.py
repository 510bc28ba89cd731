"""The steps of a graph network that move whole rows, with derivatives written by hand.

All arrays are [row, width, batch]: what is known of one line, substation or action is one stretch of memory. What
PyTorch would keep for the derivatives of every small step is many times what the processor's caches hold; here only
the states after every round are kept, and all else is overwritten at once or computed again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rl2grid.algorithms.networks.constants import keep

_TILE = 2**17
"""Numbers of the hidden layer that are held at a time while actions are scored: half a megabyte."""


def applied(step: type[torch.autograd.Function], *arguments: Any) -> Any:
    """What a step of this module gives."""
    return step.apply(*arguments)  # type: ignore[no-untyped-call]


class RowSums(nn.Module):
    """Which rows are added up to which sums, a fixed sparse matrix.

    Args:
        sums: The sum of every entry, int64 [entry].
        rows: The row that it adds to it, int64 [entry].
        n_sums: How many sums there are.
        weights: What each entry is multiplied by first, float32 [entry]; None: 1.
    """

    def __init__(self, sums: Tensor, rows: Tensor, n_sums: int, weights: Tensor | None = None) -> None:
        super().__init__()
        order = torch.argsort(sums, stable=True)
        begins = torch.searchsorted(sums[order], torch.arange(n_sums))
        keep(self, rows=rows[order], begins=begins, weights=None if weights is None else weights[order])
        self.bounds: list[int] = [*begins.tolist(), len(rows)]

    rows: Tensor
    begins: Tensor
    weights: Tensor | None

    def forward(self, values: Tensor) -> Tensor:
        """Of [row, width, batch], [sum, width, batch]."""
        return _bags(values, self.rows, self.begins, self.weights)

    def part(self, values: Tensor, first: int, after: int) -> Tensor:
        """The sums from ``first`` to before ``after`` alone."""
        begin, end = self.bounds[first], self.bounds[after]
        weights = None if self.weights is None else self.weights[begin:end]
        return _bags(values, self.rows[begin:end], self.begins[first:after] - begin, weights)


def _bags(values: Tensor, rows: Tensor, begins: Tensor, weights: Tensor | None) -> Tensor:
    """Sums of rows of ``values`` [row, width, batch]; those of a sum begin at its number in ``begins``."""
    # Of what has no derivative, the operation needs no preparations for one.
    flat = values.detach().reshape(len(values), -1)
    sums = nn.functional.embedding_bag(rows, flat, begins, mode="sum", per_sample_weights=weights)
    return sums.view(-1, *values.shape[1:])


class Incidence(nn.Module):
    """Which substation each of some elements belongs to; a line has two ends, which are elements of their own.

    Args:
        subs: The substation of every element, int64 [element].
        rows: Of whom the element is: a line of each of its ends, itself of a unit; int64 [element].
        n_sub: How many substations there are.
        per_sub: What everything at a substation is multiplied by, float32 [substation].
    """

    def __init__(self, subs: Tensor, rows: Tensor, n_sub: int, per_sub: Tensor) -> None:
        super().__init__()
        n_rows = int(rows.max()) + 1
        self.to_subs = RowSums(subs, rows, n_sub, per_sub[subs])
        self.to_rows = RowSums(rows, subs, n_rows)
        keep(self, subs=subs, rows=rows, per_sub=per_sub)

    subs: Tensor
    rows: Tensor
    per_sub: Tensor


class OnBusbars:
    """Which busbars elements are on, in a batch: busbar 1 of their substation, but for a few.

    What busbars hold is a pair: of busbars 1 [substation, width, batch], and of busbars 2 [divided substation, width,
    batch].

    Args:
        incidence: Where the elements are.
        moved: Those that are on busbar 2 anywhere in the batch, int64 [moved].
        beside: The number of each one's substation among those divided, int64 [moved].
        second: 1 where it is on busbar 2, float32 [moved, 1, batch].
        divided: Substations of which some row of the batch uses busbar 2, int64 [divided substation].
    """

    def __init__(self, incidence: Incidence, moved: Tensor, beside: Tensor, second: Tensor, divided: Tensor) -> None:
        self.incidence, self.beside, self.second, self.divided = incidence, beside, second, divided
        self.rows = incidence.rows.index_select(0, moved)
        self.subs = incidence.subs.index_select(0, moved)
        self.weighted = second * incidence.per_sub.index_select(0, self.subs).view(-1, 1, 1)

    def scaled(self, busbars: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Multiplied by what everything at a substation is multiplied by."""
        per_sub = self.incidence.per_sub.view(-1, 1, 1)
        first, second = busbars
        return first * per_sub, second * per_sub.index_select(0, self.divided)

    def added(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """What elements' ``values`` [row, width, batch] amount to at every busbar, scaled."""
        first = self.incidence.to_subs(values)
        second = values.new_zeros(len(self.divided), *values.shape[1:])
        if not len(self.rows):
            return first, second
        moved = values.index_select(0, self.rows).mul_(self.weighted)
        first.index_add_(0, self.subs, moved, alpha=-1.0)
        return first, second.index_add_(0, self.beside, moved)

    def held(self, busbars: tuple[Tensor, Tensor]) -> Tensor:
        """What the busbars of each row's elements hold together, [row, width, batch]."""
        first, second = busbars
        values: Tensor = self.incidence.to_rows(first)
        if not len(self.rows):
            return values
        moved = second.index_select(0, self.beside).sub_(first.index_select(0, self.subs)).mul_(self.second)
        return values.index_add_(0, self.rows, moved)


class Read(torch.autograd.Function):
    """What layers read of elements of some kinds: of lines, and of all others one after the other.

    Of (constants [line, width] of lines, and of every kind its features [element, feature, batch], weight [width,
    feature] and bias [width], lines first); two arrays [element, width, batch].
    """

    @staticmethod
    def forward(ctx: Any, constants: Tensor, *kinds: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(*kinds)
        lines, of_lines, bias = kinds[:3]
        read = torch.baddbmm((constants + bias).unsqueeze(-1), of_lines.expand(len(lines), -1, -1), lines)
        others = read.new_empty(sum(len(each) for each in kinds[3::3]), *read.shape[1:])
        first = 0
        for features, weight, bias in _in_threes(kinds[3:]):
            part = others[first : first + len(features)]
            torch.baddbmm(bias.unsqueeze(-1), weight.expand(len(features), -1, -1), features, out=part)
            first += len(features)
        return read, others

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_lines: Tensor, of_others: Tensor) -> tuple[Tensor | None, ...]:
        kinds = ctx.saved_tensors
        parts = (of_lines, *torch.split(of_others, [len(each) for each in kinds[3::3]]))
        gradients: list[Tensor | None] = []
        for k, (part, (features, weight, _)) in enumerate(zip(parts, _in_threes(kinds), strict=True)):
            is_asked = ctx.needs_input_grad[1 + 3 * k]
            gradients.append(torch.bmm(weight.T.expand(len(part), -1, -1), part) if is_asked else None)
            gradients.append(torch.bmm(part, features.mT).sum(dim=0))
            gradients.append(part.sum(dim=(0, 2)))
        return of_lines.sum(dim=2), *gradients


def _in_threes(tensors: Sequence[Tensor]) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Features, weight and bias of every kind."""
    return zip(tensors[::3], tensors[1::3], tensors[2::3], strict=True)


class Injected(torch.autograd.Function):
    """What units add to the busbars that they are on: (units [unit, width, batch], on) -> a pair."""

    @staticmethod
    def forward(ctx: Any, units: Tensor, on: OnBusbars) -> tuple[Tensor, Tensor]:
        ctx.on = on
        return on.added(units)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *busbars: Tensor) -> tuple[Tensor, None]:
        first, second = busbars
        return ctx.on.held((first, second)), None


class Rounds(torch.autograd.Function):
    """The states of lines after all rounds of messages, [line, width, batch].

    Of (read [line, width, batch], what is injected at busbars, a pair, in_service [line, 1, batch], on, and of every
    round two layers, of a line's own state and of what it hears: all weights [width, width], then all biases [width]).

    What lines hear of each other is the same matrix in both directions, and so its own derivative.
    """

    @staticmethod
    def forward(
        ctx: Any,
        read: Tensor,
        injected_first: Tensor,
        injected_second: Tensor,
        in_service: Tensor,
        on: OnBusbars,
        *layers: Tensor,
    ) -> Tensor:
        n_line, width, batch = read.shape
        injected = on.scaled((injected_first, injected_second))
        n = len(layers) // 2
        weights = [torch.cat(layers[k : k + 2], dim=1) for k in range(0, n, 2)]
        # Of every round, what a line is and what it hears.
        kept = [read.new_empty(n_line, 2 * width, batch) for _ in weights]
        state = torch.clamp(read, min=0.0, out=kept[0][:, :width])
        for k, both in enumerate(kept):
            first, second = on.added(state * in_service)
            heard = on.held((first.add_(injected[0]), second.add_(injected[1])))
            torch.mul(heard, in_service, out=both[:, width:])
            constant = (layers[n + 2 * k] + layers[n + 2 * k + 1]).unsqueeze(-1)
            following = (read + constant).baddbmm_(weights[k].expand(n_line, -1, -1), both)
            is_last = k + 1 == len(kept)
            state = following.relu_() if is_last else torch.clamp(following, min=0.0, out=kept[k + 1][:, :width])
        ctx.save_for_backward(in_service, state, *weights, *kept)
        ctx.on = on
        return state

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        in_service, state, *rest = ctx.saved_tensors
        on, width, n_round = ctx.on, state.shape[1], len(rest) // 2
        of_weights: list[Tensor] = []
        of_biases: list[Tensor] = []
        before = _before_relu(gradient, state)
        read: Tensor | None = None
        injected: tuple[Tensor, Tensor] | None = None
        for weight, both in zip(reversed(rest[:n_round]), reversed(rest[n_round:]), strict=True):
            read = before if read is None else read.add_(before)
            of_bias = before.sum(dim=(0, 2))
            of_biases = [of_bias, of_bias, *of_biases]
            of_weights = [*torch.bmm(before, both.mT).sum(dim=0).chunk(2, dim=1), *of_weights]
            own, heard = torch.bmm(weight.T.expand(len(state), -1, -1), before).chunk(2, dim=1)
            added = on.added(heard * in_service)
            before = _before_relu(torch.addcmul(own, on.held(added), in_service), both[:, :width])
            injected = added if injected is None else (injected[0].add_(added[0]), injected[1].add_(added[1]))
        assert read is not None
        assert injected is not None
        return read.add_(before), *injected, None, None, *of_weights, *of_biases


class Busbars(torch.autograd.Function):
    """What is known of substations: the states of their busbars 1, of their busbars 2, and their cooldown.

    Of (lines [line, width, batch], what is injected, a pair, in_service [line, 1, batch], cooldown [substation, 1,
    batch], on); [substation, 2 width + 1, batch].
    """

    @staticmethod
    def forward(
        ctx: Any,
        lines: Tensor,
        injected_first: Tensor,
        injected_second: Tensor,
        in_service: Tensor,
        cooldown: Tensor,
        on: OnBusbars,
    ) -> Tensor:
        ctx.on = on
        ctx.save_for_backward(in_service)
        injected = on.scaled((injected_first, injected_second))
        first, second = on.added(lines * in_service)
        width = lines.shape[1]
        busbars = first.new_zeros(len(first), 2 * width + 1, lines.shape[2])
        torch.add(first, injected[0], out=busbars[:, :width])
        busbars[:, width:-1].index_copy_(0, on.divided, second.add_(injected[1]))
        busbars[:, -1:] = cooldown
        return busbars

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (in_service,), on = ctx.saved_tensors, ctx.on
        width = gradient.shape[1] // 2
        first, second = on.scaled((gradient[:, :width], gradient[:, width:-1].index_select(0, on.divided)))
        return on.held((first, second)).mul_(in_service), first, second, None, gradient[:, -1:], None


class Layers(torch.autograd.Function):
    """Layers over rows of lines and of units, a layer of its own for every group of rows: [row, width, batch].

    Of (lines and units, each [row, width, batch], weight [group, width, width], bias [group, width], learned [learned,
    width], what else is added to the first rows, sign [row, 1, batch], which rows of lines and of units follow each
    other, int64, and the group of each, int64 [row]).
    """

    @staticmethod
    def forward(
        ctx: Any,
        lines: Tensor,
        units: Tensor,
        weight: Tensor,
        bias: Tensor,
        learned: Tensor,
        sign: Tensor,
        of_lines: Tensor,
        of_units: Tensor,
        group: Tensor,
    ) -> Tensor:
        inputs = lines.new_empty(len(group), *lines.shape[1:])
        torch.index_select(lines, 0, of_lines, out=inputs[: len(of_lines)])
        torch.index_select(units, 0, of_units, out=inputs[len(of_lines) :])
        constant = bias.index_select(0, group)
        constant[: len(learned)] += learned
        ctx.sizes = len(lines), len(units), len(learned)
        ctx.save_for_backward(inputs, weight, sign, of_lines, of_units, group)
        return torch.baddbmm(constant.unsqueeze(-1), weight.index_select(0, group), inputs).mul_(sign)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs, weight, sign, of_lines, of_units, group = ctx.saved_tensors
        n_line, n_unit, n_learned = ctx.sizes
        gradient = gradient * sign
        constant = gradient.sum(dim=2)
        of_weight = torch.zeros_like(weight).index_add_(0, group, torch.bmm(gradient, inputs.mT))
        of_bias = weight.new_zeros(weight.shape[:2]).index_add_(0, group, constant)
        of_inputs = torch.bmm(weight.index_select(0, group).mT, gradient)
        lines, units = (inputs.new_zeros(n, *inputs.shape[1:]) for n in (n_line, n_unit))
        lines.index_add_(0, of_lines, of_inputs[: len(of_lines)])
        units.index_add_(0, of_units, of_inputs[len(of_lines) :])
        return lines, units, of_weight, of_bias, constant[:n_learned], None, None, None, None


class Pooled(torch.autograd.Function):
    """The mean and the largest of all lines and the mean of all units, each [row, width, batch]: [3 width, batch]."""

    @staticmethod
    def forward(ctx: Any, lines: Tensor, units: Tensor) -> Tensor:
        largest = lines.amax(dim=0)
        ctx.n_unit = len(units)
        ctx.save_for_backward(lines, largest)
        return torch.cat([lines.mean(dim=0), largest, units.mean(dim=0)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        lines, largest = ctx.saved_tensors
        of_mean, of_largest, of_units = gradient.chunk(3)
        is_largest = lines.clone().eq_(largest)
        share = of_largest / is_largest.sum(dim=0)
        of_lines = torch.addcmul(of_mean / len(lines), is_largest, share)
        return of_lines, (of_units / ctx.n_unit).expand(ctx.n_unit, -1, -1)


class Scores(torch.autograd.Function):
    """What sums of rows are worth: weight . relu(sum of rows) + bias, [action, number, batch].

    Of (rows [row, width, batch], weight [number, width], bias [number], what is added to the first number of action 0,
    the rows of every action, and the actions of every row).
    """

    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor, first: Tensor, actions: RowSums, back: RowSums
    ) -> Tensor:
        ctx.actions, ctx.back = actions, back
        ctx.save_for_backward(rows, weight)
        scores = rows.new_empty(len(actions.begins), len(weight), rows.shape[2])
        for begin, after in _tiles(actions, rows):
            hidden = actions.part(rows, begin, after).relu_()
            torch.bmm(weight.expand(after - begin, -1, -1), hidden, out=scores[begin:after])
        scores.add_(bias.unsqueeze(-1))
        scores[0, 0] += first
        return scores

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight = ctx.saved_tensors
        actions, back = ctx.actions, ctx.back
        gradient = gradient.contiguous()
        of_weight, of_sums = torch.zeros_like(weight), rows.new_empty(len(gradient), *rows.shape[1:])
        for begin, after in _tiles(actions, rows):
            hidden = actions.part(rows, begin, after).relu_()
            part, of_hidden = gradient[begin:after], of_sums[begin:after]
            of_weight += torch.bmm(part, hidden.mT).sum(dim=0)
            if len(weight) == 1:  # A product of two vectors is no work for a product of matrices.
                torch.mul(weight.view(1, -1, 1), part, out=of_hidden)
            else:
                torch.bmm(weight.T.expand(after - begin, -1, -1), part, out=of_hidden)
            torch.ops.aten.threshold_backward(of_hidden, hidden, 0.0, grad_input=of_hidden)
        return back(of_sums), of_weight, gradient.sum(dim=(0, 2)), gradient[0, 0].sum(), None, None


def _tiles(actions: RowSums, rows: Tensor) -> list[tuple[int, int]]:
    """First actions, and those after the last, of parts of which the hidden layer stays in the processor's cache."""
    n_actions = len(actions.begins)
    step = max(_TILE // max(rows[0].numel(), 1), 1)
    return [(first, min(first + step, n_actions)) for first in range(0, n_actions, step)]


def _before_relu(gradient: Tensor, after: Tensor) -> Tensor:
    """The gradient of what became ``after`` by a ReLU."""
    passed: Tensor = torch.ops.aten.threshold_backward(gradient, after, 0.0)
    return passed
