"""What a run has used: energy and CO2, added up over its interruptions in ``energy.json``.

Every process that worked on the run is one part of the account. CodeCarbon's figures are taken when that package is
installed; else, and for processes that were killed, they are estimated:

    energy = processor seconds x WATTS_PER_CORE          CO2 = energy x CO2_PER_KWH

CodeCarbon looks up where the machine is. Where it cannot (no internet) it assumes a place that lives on hydropower: its
energy is taken then, and ``CO2_PER_KWH``. The estimate counts busy cores only: no memory, no graphics card, no cooling.
Of a process that was killed, what came after its last checkpoint is missing.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rl2grid.records.trainings import read_energy, write_energy

WATTS_PER_CORE = 12.0
"""Power of a busy core in W: an assumption, thermal design power by number of cores of common processors."""
CO2_PER_KWH = 0.475
"""kg per kWh: the world's electricity in 2018 (IEA, Global Energy & CO2 Status Report 2019)."""

_UNKNOWN_PLACE = (46.8, -71.2)
"""Latitude and longitude that CodeCarbon assumes if it cannot look them up (its ``GeoMetadata.from_geo_js``)."""

_PLACE_ASSUMED = "codecarbon, the world's mean CO2"
"""Method of a part whose energy is CodeCarbon's."""

_ASSUMPTIONS = {
    "watts_per_core": WATTS_PER_CORE,
    "co2_kg_per_kwh": CO2_PER_KWH,
    "explanation": (
        "Processor seconds of the run's processes x watts per busy core (assumed, about the thermal design power of a "
        "common processor by its number of cores) x carbon intensity (world average of 2018, IEA Global Energy & CO2 "
        "Status Report 2019). Memory, graphics cards and cooling are not counted."
    ),
}


class EnergyAccount:
    """The account of a run folder, with a part for this process."""

    def __init__(self, folder: Path) -> None:
        """Begin to count; earlier parts are kept."""
        self._folder = folder
        account = read_energy(folder)
        self._earlier = [] if account is None else account["parts"]
        self._tracker = _started_tracker()
        self._began = time.perf_counter()
        self._processor_began = _processor_seconds()

    def save(self) -> None:
        """Write the account with the estimate for this process so far."""
        self._write(self._estimate())

    def finish(self) -> None:
        """Write the account with the final figures for this process."""
        self._write({**self._estimate(), **_measured(self._tracker)})

    def _estimate(self) -> dict[str, Any]:
        seconds = _processor_seconds() - self._processor_began
        energy = seconds * WATTS_PER_CORE / 3.6e6
        return {
            "method": "estimate",
            "energy_kwh": energy,
            "co2_kg": energy * CO2_PER_KWH,
            "cpu_seconds": seconds,
            "wall_seconds": time.perf_counter() - self._began,
        }

    def _write(self, part: Mapping[str, Any]) -> None:
        parts = [*self._earlier, part]
        names = ("energy_kwh", "co2_kg", "cpu_seconds", "wall_seconds")
        account = {
            "method": " and ".join(sorted({each["method"] for each in parts})),
            **{name: sum(each[name] for each in parts) for name in names},
            "assumptions": _ASSUMPTIONS,
            "parts": parts,
        }
        write_energy(self._folder, account)


def energy_line(folder: Path) -> str | None:
    """Energy and CO2 of a run in words; None if it has no account."""
    account = read_energy(folder)
    if account is None:
        return None
    return f"{account['energy_kwh']:.3g} kWh, {account['co2_kg']:.3g} kg CO2 ({account['method']})"


def _processor_seconds() -> float:
    """Of this process with all its threads, and of its child processes that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _started_tracker() -> Any:
    """CodeCarbon at work; None where it is not installed or does not work."""
    try:
        from codecarbon import EmissionsTracker

        tracker = EmissionsTracker(
            output_methods=[], log_level="critical", tracking_mode="process", allow_multiple_runs=True
        )
        tracker.start()
    except Exception:  # no reason to end a training
        return None
    return tracker


def _measured(tracker: Any) -> dict[str, Any]:
    """CodeCarbon's figures for this process; nothing if there are none."""
    if tracker is None:
        return {}
    try:
        co2 = tracker.stop()
        data = tracker.final_emissions_data
        energy, place = float(data.energy_consumed), (data.latitude, data.longitude)
        if place == _UNKNOWN_PLACE:
            return {"method": _PLACE_ASSUMED, "energy_kwh": energy, "co2_kg": energy * CO2_PER_KWH}
        return {"method": "codecarbon", "energy_kwh": energy, "co2_kg": float(co2)}
    except Exception:  # no reason to end a training
        return {}
