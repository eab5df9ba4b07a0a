"""What is simulated: a calibration cube of a random instrument, which is told to be the nominal one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.settings import NARROW, SKY, Setting
from benchmarks.random_instrument.tolerances import drawn_errors
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.paper.common.scenes import JITTER_MAS, LOW_GAIN, NCPA_NM, NCPA_SCATTER_NM
from irlos_pipe.simulate.recordings.files import Planned
from irlos_pipe.simulate.recordings.series import plan_recordings
from irlos_pipe.simulate.recordings.spec import load_spec

SEEINGS_ARCSEC = (0.35, 1.0)
MAG_J = 7.0
POINTS_PER_BAND = 5  # wavelengths of the simulation; the side-car states three
EFFECT = "effects."
SCENE, INSTRUMENT = range(2)  # streams of random numbers of a case


@dataclass(frozen=True)
class Case:
    """One cube; what is drawn follows from `seed` and `index`.

    Attributes
    ----------
    diagnosed : bool
        Whether it is calibrated again with what `diagnose` finds.
    without : str
        Name of the error that the instrument does not have; empty: it has all.
    """

    seed: int
    index: int
    frames: int
    diagnosed: bool = False
    without: str = ""
    window: int = 64

    @property
    def name(self) -> str:
        """Return the name of its file."""
        without = f"without_{self.without}" if self.without else ""
        parts = (f"{self.index:04d}", "diagnosed" if self.diagnosed else "", without)
        return ".".join(part for part in parts if part)

    @property
    def seeing_arcsec(self) -> float:
        """Return the seeing on SPARTA's scale; both in turn."""
        return SEEINGS_ARCSEC[self.index % len(SEEINGS_ARCSEC)]

    @property
    def setting(self) -> Setting:
        """Return what the suite of `diagnose` knows of such recordings."""
        return Setting(SKY, NARROW, MAG_J, self.frames, self.window)

    def spec(self) -> dict[str, Any]:
        """Return the case as a spec of `irlos simulate`."""
        rng = self._rng(SCENE)
        sections = self.setting.sections(rng)
        total_nm = max(float(rng.normal(NCPA_NM, NCPA_SCATTER_NM)), NCPA_SCATTER_NM)
        sections |= {
            "simulation": "random_instrument",
            "seed": int(rng.integers(2**31)),
            "ncpa": {"total_nm": total_nm, "modes": 50},
            "sky": {**sections["sky"], "seeing_arcsec": self.seeing_arcsec},
            "motion": {"rms_mas": JITTER_MAS},
            "detector": {"e_per_adu": LOW_GAIN.e_per_adu, "read_noise_e": LOW_GAIN.read_noise_e},
            "sampling": {**sections["sampling"], "points_per_band": POINTS_PER_BAND},
            "effects": {},
            "recordings": {"cube": self.setting.recording()},
        }
        for name, changes in drawn_errors(self.setting, self._rng(INSTRUMENT)).items():
            if name != self.without:
                _change(sections, changes)
        return sections

    def planned(self, spec_path: Path) -> Planned:
        """Return the recording; its spec is written to `spec_path`."""
        spec_path.write_text(yaml_text(self.spec()))
        (planned,) = plan_recordings(load_spec(spec_path))
        return planned

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.index, stream])


def _change(sections: dict[str, Any], changes: dict[str, dict[str, Any]]) -> None:
    """Put the keys of `changes` into the `sections` of a spec, effects into theirs."""
    for where, keys in changes.items():
        holder = sections["effects"] if where.startswith(EFFECT) else sections
        name = where.removeprefix(EFFECT)
        holder[name] = {**holder.get(name, {}), **keys}


def all_cases(seed: int, draws: int, diagnosed: int, frames: int) -> list[Case]:
    """Return `draws` cases, the first `diagnosed` of them diagnosed; further draws change nothing."""
    return [Case(seed, index, frames, index < diagnosed) for index in range(draws)]
