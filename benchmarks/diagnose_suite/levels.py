"""How large hidden effects are, from sizes that just show to sizes that are hard to overlook.

Weak is about four times the smallest detectable size that `diagnose` prints for clean recordings of the
setting, medium and strong are what instruments are known to do. Where a size is no single number: RMS
of the modes or petals, displacement of the stop.
"""

from __future__ import annotations

MEDIUM = "medium"
LEVELS = ("weak", MEDIUM, "strong")

# Effect: sizes in every setting; by setting where they differ.
SIZES: dict[str, dict[str, tuple[float, float, float]]] = {
    "tip_tilt_jitter": {"bench": (1.6, 4.0, 9.0), "sky": (5.0, 8.0, 12.0)},  # mas
    "vibration": {"bench": (2.0, 5.0, 10.0), "sky": (10.0, 20.0, 30.0)},  # mas
    "seeing_halo": {"bench": (30.0, 60.0, 110.0), "sky": (95.0, 120.0, 150.0)},  # nm RMS
    "atmospheric_dispersion": {  # mas/µm
        "bench_narrow": (60.0, 150.0, 400.0),
        "bench_broad": (0.5, 4.0, 30.0),
        "sky_narrow": (600.0, 900.0, 1800.0),
        "sky_broad": (9.0, 25.0, 80.0),
    },
    "spectrum": {  # nm in a narrow band, 1/µm between J and H
        "bench_narrow": (1.0, 5.0, 20.0),
        "bench_broad": (0.02, 0.1, 0.5),
        "sky_narrow": (12.0, 30.0, 60.0),
        "sky_broad": (0.5, 0.9, 1.5),
    },
    "plate_scale": {"bench": (0.0005, 0.003, 0.015), "sky": (0.0075, 0.012, 0.02)},
    "anamorphism": {"bench": (0.0015, 0.006, 0.03), "sky": (0.02, 0.035, 0.05)},
    "diversity_error": {"bench": (5.0, 15.0, 40.0), "sky": (5.0, 15.0, 40.0)},  # nm
    "pupil_misregistration": {"bench": (0.02, 0.06, 0.2), "sky": (0.1, 0.2, 0.35)},  # m
    "pupil_geometry": {"bench": (0.035, 0.1, 0.25), "sky": (0.17, 0.28, 0.45)},  # m of the hole
    "amplitude_aberration": {"bench": (0.004, 0.02, 0.06), "sky": (0.05, 0.08, 0.12)},
    "low_wind_effect": {"bench": (6.0, 30.0, 100.0), "sky": (65.0, 110.0, 180.0)},  # nm
    "high_order_ncpa": {"bench": (1.0, 6.0, 25.0), "sky": (10.0, 20.0, 35.0)},  # nm RMS
    "phase_bump": {"bench": (12.0, 50.0, 150.0), "sky": (200.0, 400.0, 600.0)},  # nm
    "pupil_spot": {"bench": (0.025, 0.1, 0.5), "sky": (0.5, 0.75, 1.0)},  # opacity
    "ncpa_drift": {"bench": (4.0, 15.0, 40.0), "sky": (25.0, 50.0, 90.0)},  # nm RMS
    "chromatic_ncpa": {  # nm RMS per µm
        "bench_narrow": (50.0, 150.0, 400.0),
        "bench_broad": (5.0, 30.0, 120.0),
        "sky_narrow": (50.0, 150.0, 400.0),
        "sky_broad": (50.0, 100.0, 200.0),
    },
    "filter_ncpa": {"bench": (5.0, 15.0, 40.0), "sky": (5.0, 15.0, 40.0)},  # nm RMS
    "companion": {"bench": (0.0003, 0.005, 0.05), "sky": (0.005, 0.02, 0.08)},
    "ghost": {"bench": (0.0003, 0.005, 0.05), "sky": (0.005, 0.02, 0.08)},
    "interpixel_crosstalk": {"bench": (0.012, 0.03, 0.08), "sky": (0.05, 0.1, 0.18)},
    "detector_nonlinearity": {"bench": (0.01, 0.03, 0.1), "sky": (0.1, 0.17, 0.24)},
    "background_gradient": {"bench": (0.01, 0.1, 1.0), "sky": (0.12, 0.4, 1.5)},  # e-/px
    "bad_pixels": {"bench": (100.0, 500.0, 3000.0), "sky": (300.0, 1000.0, 5000.0)},  # e-
    "focus_stage_hysteresis": {"bench": (15.0, 30.0, 60.0), "sky": (15.0, 30.0, 60.0)},  # nm
    "focus_stage_offset": {"bench": (15.0, 40.0, 100.0), "sky": (15.0, 40.0, 100.0)},  # nm
    "focus_stage_scale": {"bench": (0.08, 0.15, 0.25), "sky": (0.08, 0.15, 0.25)},
}


def size_of(effect: str, setting: str, level: str) -> float:
    """Size of an effect at a level, before it is drawn about it."""
    sizes = SIZES[effect]
    chosen = sizes[setting] if setting in sizes else sizes[setting.partition("_")[0]]
    return chosen[LEVELS.index(level)]
