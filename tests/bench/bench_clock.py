"""Clock filters: error of the mapped time against the truth, µs.

The hull as `polecal.drivers.clock` has it, Olson's filter (IROS 2010) and the raw stamps, on the same data:
75 Hz, ±50 ppm with wander, 1 % of the stamps lost, and a device that restarts. The last rows are the real
receiver's arrivals, against a line under all of them.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polecal.drivers.clock import Clock

HEADINGS = ("stamps", "filter", "from, s", "median", "p99", "max")

PERIOD_NS = 13_320_000
SECONDS = 240
LATENCIES_MS = {
    "USB timer 16 ms": lambda rng, n: rng.uniform(0, 16, n),
    "USB timer 1 ms": lambda rng, n: rng.uniform(0, 1, n),
    "UART": lambda rng, n: rng.exponential(0.1, n),
}
CAPTURE = Path(__file__).resolve().parents[3] / "shared/captures/span_driver_ins_ppp_driven_20hz.bin"


class Raw:
    """The stamps as they are."""

    def update(self, device_ns: int, host_ns: int) -> None:
        self._host_ns = host_ns

    def to_host(self, device_ns: int) -> int:
        return self._host_ns


class Olson:
    """Olson's passive filter: the least late stamp so far, which ages by the largest drift there may be."""

    def __init__(self, max_drift: float) -> None:
        self._max_drift = max_drift
        self._best: tuple[int, int] | None = None

    def update(self, device_ns: int, host_ns: int) -> None:
        if self._best is not None:
            passed_ns = device_ns - self._best[0]
            if host_ns - self._best[1] > passed_ns * (1 + self._max_drift):
                return
        self._best = device_ns, host_ns

    def to_host(self, device_ns: int) -> int:
        assert self._best is not None
        return self._best[1] + device_ns - self._best[0]


def stamps(latency_ms, *, ppm: float, seed: int):
    """Give (device ns, true host ns, stamp ns) of a clock with drift and wander."""
    rng = np.random.default_rng(seed)
    count = int(SECONDS * 1e9 / PERIOD_NS)
    device_ns = np.arange(count) * PERIOD_NS
    wander = np.cumsum(rng.normal(size=count)) * 2e-9  # of the rate: 0.3 ppm over the run
    true_ns = np.cumsum(PERIOD_NS * (1 + ppm * 1e-6 + wander))
    kept = rng.random(count) > 0.01
    late_ns = latency_ms(rng, count) * 1e6
    return device_ns[kept], true_ns[kept], (true_ns + late_ns)[kept]


def errors_us(clock, device_ns, true_ns, stamp_ns):
    out = np.empty(len(device_ns))
    base_ns = 10**12
    for index, (device, true, stamp) in enumerate(zip(device_ns, true_ns, stamp_ns, strict=True)):
        clock.update(int(device), base_ns + round(stamp))
        out[index] = abs(clock.to_host(int(device)) - base_ns - true) / 1e3
    return out


def rows() -> Iterator[tuple[object, ...]]:
    for name, latency_ms in LATENCIES_MS.items():
        data = [stamps(latency_ms, ppm=ppm, seed=seed) for seed, ppm in enumerate((50.0, -50.0))]
        for label, make in (
            ("raw", Raw),
            ("Olson, 100 ppm", lambda: Olson(100e-6)),
            ("hull", lambda: Clock(max_drift=200e-6)),
        ):
            errors = [errors_us(make(), *one) for one in data]
            for begin_s in (10, 120):
                late = np.concatenate(
                    [error[one[0] > begin_s * 1e9] for error, one in zip(errors, data, strict=True)]
                )
                yield name, label, str(begin_s), np.median(late), np.quantile(late, 0.99), late.max()
    yield from _restart()
    if CAPTURE.exists():
        yield from _real_receiver()


def _restart() -> Iterator[tuple[object, ...]]:
    """The device counts from zero again after 60 s; from then on."""
    for name, latency_ms in LATENCIES_MS.items():
        device_ns, true_ns, stamp_ns = stamps(latency_ms, ppm=50.0, seed=7)
        again = device_ns > 60e9
        device_ns = np.where(again, device_ns - device_ns[again][0], device_ns)
        errors = errors_us(Clock(max_drift=200e-6), device_ns, true_ns, stamp_ns)[again]
        settled = errors[device_ns[again] > 5e9]
        yield f"{name}, restart", "hull", "5", np.median(settled), np.quantile(settled, 0.99), settled.max()


def _real_receiver() -> Iterator[tuple[object, ...]]:
    from polecal.drivers.emulated.receiver import load_recording, recorded_path
    from polecal.drivers.novatel_span import Framer, nav_state

    data, offsets, arrival_s = load_recording(CAPTURE)
    truth_ns = recorded_path(data, offsets, arrival_s)[0].t_s * 1e9
    framer, ends = Framer(), [*offsets[1:], len(data)]
    epochs = []
    for begin, end, arrival in zip(offsets, ends, arrival_s, strict=True):
        t_ns = round((arrival - arrival_s[0]) * 1e9)
        epochs += [(nav_state(frame), t_ns) for frame in framer.feed(data[begin:end], t_ns)]
    device_ns, stamp_ns = zip(*((nav.gps_ns, t_ns) for nav, t_ns in epochs if nav is not None), strict=True)
    for label, clock in (
        ("raw", Raw()),
        ("Olson, 100 ppm", Olson(100e-6)),
        ("hull", Clock(max_drift=200e-6)),
    ):
        error = errors_us(clock, device_ns, truth_ns, stamp_ns)[200:]
        yield "real receiver, TCP", label, "10", np.median(error), np.quantile(error, 0.99), error.max()
