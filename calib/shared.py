"""Passes that two lasers saw together to a better mount of the one that saw fewer.

In a pass the navigation is off by the same for both: both have the pole in the same wrong place, and both
mounts are moved by it as if the body were. The laser that saw more passes can tell by how much those that
the other saw, too, are off the mean of all of them. That is taken off the other's mount, of each unknown as
much as what the passes say of both shows to be common.

Only how the one's passes scatter about its own result comes into it, not where it has the pole: what is
wrong alike in all of its passes does not reach the other. That there is but one pole is of no use: with
passes from all headings a mount is found as well without knowing where it is (`tests/bench/bench_shared.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polecal.calib.estimate import Pass, Result, Setup, Shared, scatters_of
from polecal.calib.geometry import Array, rotation, rotation_gradient, skew, wrap
from polecal.calib.observations import PARAMETERS, Mount
from polecal.calib.solve import Form, cost_m
from polecal.calib.student import exceeded

_FEWEST_TOGETHER = 8
_APART_NS = 5_000_000_000  # from one laser's last sight of the pole to the other's first: no new pass
_CLEARLY = 0.001  # of lasers without a common error one unknown looks as if there were one
_BY_CHANCE = 0.05  # and any other, where one has shown it
_WORTHWHILE = 0.95  # of the σ without
_FARTHEST = 4.0  # σ of what is taken off
_NOTHING = 1e-30


@dataclass(frozen=True, slots=True)
class Witness:
    """A laser's passes, their first and last times in ns of one clock for all lasers, and its own result."""

    name: str
    passes: Sequence[Pass]
    spans_ns: Sequence[tuple[int, int]]
    setup: Setup
    result: Result

    def says(self) -> tuple[list[tuple[int, int]], Array]:
        """Give the used passes' times, and what each says: Tukey's pseudo-values (P, 6), less their mean."""
        spans = {one.id: span for one, span in zip(self.passes, self.spans_ns, strict=True)}
        left_out = np.stack(list(self.result.left_out.values()))
        moved = left_out - left_out[0]
        moved[:, 3:6] = wrap(moved[:, 3:6])
        return [spans[number] for number in self.result.left_out], (1 - len(moved)) * (
            moved - moved.mean(axis=0)
        )


def share(witnesses: Sequence[Witness]) -> dict[str, Result]:
    """Give those results, by laser, that are better for what another laser saw.

    Of lasers that agree (`agreement.disagreements`). Only what is accepted by itself gives or takes.
    """
    good = [one for one in witnesses if one.result.verdict.accepted and one.result.left_out]
    found = {}
    for taker in good:
        helped = [made for giver in good if giver is not taker and (made := _helped(taker, giver))]
        if helped:
            found[taker.name] = min(helped, key=lambda made: sum(r - 1 for r in made[0].sigma_ratio.values()))
    return {taker.name: _result(taker, *found[taker.name]) for taker in good if taker.name in found}


def _helped(taker: Witness, giver: Witness) -> tuple[Shared, Array, Array] | None:
    """Give what the giver's help is worth, what it adds to the taker's mount (6,), and to its covariance.

    None where it is not worth its while, or where it would move the mount by more than chance allows.
    """
    seen = _together(taker, giver)
    if seen is None:
        return None
    adds, off, both, passes = seen
    count, square = int(both.sum()), (off**2).sum(axis=0)
    product, of_both = (adds * off).sum(axis=0), (adds[both] ** 2).sum(axis=0) * (off[both] ** 2).sum(axis=0)
    common = product / np.maximum(square, _NOTHING)
    alike = product / np.sqrt(np.maximum(of_both, _NOTHING))
    chance, clear = (
        t / np.sqrt(count - 2 + t**2) for t in (exceeded(2 * p, count - 2) for p in (_BY_CHANCE, _CLEARLY))
    )
    before = passes / (passes - 1) * (adds**2).sum(axis=0)
    after = passes / (passes - 2) * ((adds - common * off) ** 2).sum(axis=0)  # what is common was told, too
    ratio = np.sqrt(after / np.maximum(before, _NOTHING))
    taken = (alike > (chance if (alike > clear).any() else 1.0)) & (ratio <= _WORTHWHILE)
    common = np.where(taken, common, 0.0)
    change = -common * off.sum(axis=0)
    if not taken.any() or (np.abs(change) > _FARTHEST * common * np.sqrt(square))[taken].any():
        return None
    left = (adds - common * off) * np.sqrt(passes / np.where(taken, passes - 2, passes - 1))
    worth = {name: float(part) for name, part, yes in zip(PARAMETERS, ratio, taken, strict=True) if yes}
    covariance = left.T @ left - passes / (passes - 1) * adds.T @ adds
    return Shared(giver.name, count, worth), change, covariance


def _together(taker: Witness, giver: Witness) -> tuple[Array, Array, NDArray[np.bool_], int] | None:
    """Give what each pass adds to the taker's error, and to what the giver has their common passes off by.

    Two arrays (passes of either, 6), which of the passes are common, and how many are the taker's; None where
    too few are common.
    """
    (spans, own), (their_spans, theirs) = taker.says(), giver.says()
    theirs = theirs @ _as_moved(giver.result.vector, taker.result.vector).T
    where = _matched(spans, their_spans)
    met = where >= 0
    times = np.bincount(where[met], minlength=len(theirs))
    if np.count_nonzero(times) < _FEWEST_TOGETHER:
        return None
    where[~met] = len(theirs) + np.arange(np.count_nonzero(~met))
    adds, off = np.zeros((2, len(theirs) + np.count_nonzero(~met), len(PARAMETERS)))
    np.add.at(adds, where, own / len(own))
    off[: len(theirs)] = (times / times.sum() - 1.0 / len(theirs))[:, None] * theirs
    both = np.concatenate([times > 0, np.zeros(len(adds) - len(theirs), dtype=bool)])
    return adds, off, both, len(own)


def _matched(spans: Sequence[tuple[int, int]], theirs: Sequence[tuple[int, int]]) -> NDArray[np.int64]:
    """Give for each span the number of theirs that shares most of its time, or is next to it; else -1."""
    first, last = np.array(spans).T[:, :, None]
    their_first, their_last = np.array(theirs).T[:, None]
    shared_ns = np.minimum(last, their_last) - np.maximum(first, their_first)  # negative: apart
    most = shared_ns.argmax(axis=1)
    return np.where(shared_ns[np.arange(len(most)), most] >= -_APART_NS, most, -1)


def _as_moved(one: Array, other: Array) -> Array:
    """Give how the other mount's unknowns move where one's do with the body that bears both, (6, 6)."""
    turned, turns = (_turns(vector) for vector in (one, other))
    moved = np.zeros((6, 6))
    moved[:3, :3] = np.eye(3)
    moved[:3, 3:] = -skew(other[:3] - one[:3]) @ turned
    moved[3:, 3:] = np.linalg.pinv(turns) @ turned
    return moved


def _turns(vector: Array) -> Array:
    """Give the turns about the body's axes, (3, 3), that roll, pitch and yaw are each."""
    spun = rotation_gradient(vector[3:6]) @ rotation(vector[3:6]).T  # [ω]×
    return np.stack([spun[:, 2, 1], spun[:, 0, 2], spun[:, 1, 0]])


def _result(taker: Witness, shared: Shared, change: Array, covariance: Array) -> Result:
    """Give the taker's result with what was added to its mount and its covariance."""
    old = taker.result
    moved = replace(
        old,
        mount=Mount.from_vector(old.mount.vector + change),
        covariance=old.covariance + covariance,
        shared=shared,
    )
    used = [one for one in taker.passes if one.id not in old.set_aside]
    pole, ground = scatters_of(used, taker.setup.pole_radius_m)
    return replace(
        moved,
        sigma=Mount.of_variance(np.diag(moved.covariance)),
        cost_m=cost_m(Form.of(pole, ground, np.ones(len(used), dtype=bool)), moved.vector),
    )
