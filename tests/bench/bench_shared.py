"""A laser that sees fewer passes than another: its errors alone, and with what the other saw of them.

A vehicle with two lasers, RTK-like errors: 10 mm, 0.01° roll and pitch, 0.04° yaw of each pass, the same for
both lasers; 36 passes, all of which the first sees. The second sees every third, every second, or those that
have the pole on its side. "relative" is the error of the second's mount on the first. In the last rows the
place of the pole is known, which is the most that another laser could tell of it without passes in common: of
passes that head all around, and of those within half a turn.
"""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from polecal.calib import PARAMETERS, Criteria, Mount, Need, Setup, estimate
from polecal.calib.estimate import passes_of, scatters_of
from polecal.calib.report.rig import Rig, drives
from polecal.calib.shared import Witness, share
from polecal.calib.solve import EXTRAS, Form, minimise

HEADINGS = (
    "way",
    "unknown",
    "alone",
    "shared",
    "gain",
    "relative",
    "gain",
    "claimed, alone",
    "shared",
    "done, %",
)
UNITS = np.array([1e3, 1e3, 1e3, *np.degrees([1, 1, 1])])  # rows are in mm and °

RUNS = 100
PASSES = 36
RIG = Rig(
    Mount(-0.029, -0.360, -0.996, -0.528, -8.182, -2.017),
    passes=PASSES,
    speeds_mps=(1.5, 2.5, -1.0),
    approach_m=(9.0, -9.0),
)
BESIDE, RIGHT, REAR = (
    Mount(0.1, 0.4, -0.9, 0.7, -7.0, 1.5),
    Mount(-0.6, 0.35, -0.95, 0.4, -7.5, 88.0),
    Mount(-1.5, 0.1, -0.95, 0.3, -8.5, 178.0),
)
LOOSE = Criteria(
    cost_m=1.0, left_out_m=1.0, improvement=9.0, doubling=9.0, max_sigma=(1.0,) * 6, max_shift_sigmas=99.0
)
FEWEST_RETURNS = 20


@dataclass(frozen=True)
class Way:
    name: str
    second: Mount
    every: int
    pole_returns: int
    extras: frozenset[str] = frozenset()


WAYS = (
    Way("one in three", BESIDE, 3, 200),
    Way("one in three, extras", BESIDE, 3, 200, frozenset(EXTRAS)),
    Way("one in two", BESIDE, 2, 200),
    Way("rear, one in three", REAR, 3, 200),
    Way("side", RIGHT, 1, 100),
    Way("all", BESIDE, 1, 200),
)


def run(way: Way, seed: int) -> np.ndarray:
    """Errors (7, 6): of the second alone, shared; on the first, both; σ, both; and whether it was shared."""
    mounts = (RIG.mount, way.second)
    witnesses = []
    for mount, returns in zip(
        mounts,
        drives(RIG, mounts, seed, way.pole_returns * PASSES, 2 * way.pole_returns * PASSES),
        strict=True,
    ):
        passes = [one for one in passes_of(returns, 30) if sum(one.pole_returns.values()) >= FEWEST_RETURNS]
        if mount is way.second:
            passes = [one for one in passes if 7 * one.id % PASSES < PASSES / way.every]
        near = Mount.from_vector(mount.vector + np.array([0.03, -0.03, 0.03, 0.01, 0.01, -0.01]))
        setup = Setup(near, pole_radius_m=0.04, extras=way.extras, criteria=LOOSE, need=Need(30, 0, 0, 0))
        spans = [(one.id * 10**11, one.id * 10**11 + 10**10) for one in passes]
        witnesses.append(
            Witness("second" if witnesses else "first", passes, spans, setup, estimate(passes, setup))
        )
    first, second = (one.result for one in witnesses)
    helped = share(witnesses).get("second", second)
    off = [
        of.mount.vector - mount.vector
        for of, mount in ((first, mounts[0]), (second, mounts[1]), (helped, mounts[1]))
    ]
    return np.stack(
        [off[1], off[2], off[1] - off[0], off[2] - off[0]]
        + [np.sqrt(np.diag(of.covariance)) for of in (second, helped)]
        + [np.array([of in (helped.shared.sigma_ratio if helped.shared else ()) for of in PARAMETERS], float)]
    )


def place_known(turn: int, seed: int) -> np.ndarray:
    """Errors (2, 6) of one laser over headings of so many degrees: its pole's place unknown, and known."""
    (returns,) = drives(RIG, [RIG.mount], seed, 200 * PASSES, 400 * PASSES)
    passes = passes_of(returns, 30)[: PASSES * turn // 360]
    used = np.ones(len(passes), dtype=bool)
    pole, ground = scatters_of(passes, 0.04)
    start = np.concatenate([RIG.mount.vector, np.zeros(len(EXTRAS))])
    form = Form(pole.form(used, 1.0), ground.form(used, 1.0))
    weight = pole.weight(1.0)
    mean = weight / weight.sum() @ pole.means(np.eye(len(form.pole)))  # from n's origin, where the pole is
    known = replace(form, pole=form.pole + weight.sum() / pole.count.sum() * np.outer(mean, mean))
    return np.stack([minimise(of, start, EXTRAS)[:6] - start[:6] for of in (form, known)])


def rows() -> Iterator[tuple[str | float, ...]]:
    with ProcessPoolExecutor() as pool:
        for way in WAYS:
            found = np.stack(list(pool.map(partial(run, way), range(RUNS), chunksize=5)))
            alone, shared, apart, together, claimed, claimed_shared = (
                np.sqrt((found[:, :6] ** 2).mean(axis=0)) * UNITS
            )
            for index, key in enumerate(PARAMETERS):
                yield (
                    way.name,
                    key,
                    *(alone[index], shared[index], shared[index] / alone[index]),
                    *(together[index], together[index] / apart[index]),
                    *(claimed[index] / alone[index], claimed_shared[index] / shared[index]),
                    100 * found[:, 6, index].mean(),
                )
        for turn in (360, 180):
            found = np.stack(list(pool.map(partial(place_known, turn), range(RUNS), chunksize=5)))
            unknown, known = np.sqrt((found**2).mean(axis=0)) * UNITS
            for index, key in enumerate(PARAMETERS):
                ratio = known[index] / unknown[index]
                yield (f"place known, {turn}°", key, unknown[index], known[index], ratio, "", "", "", "", "")
