"""Every image-forming effect at a strong level, for the tests of images and of derivatives."""

from dataclasses import replace

import torch

from helpers.optics_cases import BAND, J_AND_H, RESIDUAL_LAW, settings
from irlos_pipe.effects import CATALOGUE, Conditions, Effect, EffectSet
from irlos_pipe.optics.psf import PsfModel

SPECTRUM = J_AND_H[1::3]
WINDOW = (36, 33)
NOLLS = tuple(range(2, 16))
CONDITIONS = Conditions(settings(WINDOW, SPECTRUM), BAND, RESIDUAL_LAW, 0.5, NOLLS[-1])
# The window does not show the edge of the field that IRLOS's AO corrects.
LOW_CUTOFF = replace(CONDITIONS, band=replace(BAND, cutoff_per_m=0.5))
STRONG = {
    "tip_tilt_jitter": {"sigma_mas": 12.0},
    "vibration": {"sigma_mas": 14.0, "angle_deg": 35.0},
    "seeing_halo": {"wfe_nm": 150.0},
    "uneven_residual": {"edge": 0.35, "side_x": -0.15, "side_y": 0.1},
    "ao_cutoff": {"per_m": 0.62},
    "atmospheric_dispersion": {"mas_per_um": 60.0, "angle_deg": 120.0},
    "spectrum": {"wavelength_nm": 1440.0, "slope": 0.5, "width": 1.1},
    "plate_scale": {"fraction": 0.02},
    "anamorphism": {"fraction": 0.04, "angle_deg": 115.0},
    "diversity_error": {"nm": 60.0},
    "pupil_misregistration": {"dx_m": 0.12, "dy_m": -0.08, "rotation_deg": 4.0},
    "pupil_geometry": {"obscuration_m": 1.4, "vane_width_m": 0.06},
    "amplitude_aberration": {"zernike": {2: 0.08, 5: -0.06, 8: 0.05}},
    "pupil_spot": {"opacity": 0.9, "x_m": -1.7, "y_m": 1.2, "radius_m": 0.4},
    "low_wind_effect": {
        "piston_nm": [150.0, -120.0, 90.0, -60.0],
        "tip_nm": [0.0, 40.0, 0.0, -30.0],
        "tilt_nm": [35.0, 0.0, -25.0, 0.0],
    },
    "segment_piston": {"piston_nm": [90.0, -70.0, 40.0, -50.0]},
    "high_order_ncpa": {"zernike_nm": {20: 50.0, 37: -40.0, 66: 30.0}},
    "phase_bump": {"nm": 250.0, "x_m": 1.6, "y_m": -1.1, "width_m": 0.45},
    "ncpa_drift": {"zernike_nm": {4: 120.0, 7: -80.0}},
    "chromatic_ncpa": {"zernike_nm_per_um": {4: 180.0, 7: -240.0, 11: 120.0}},
    "filter_ncpa": {"zernike_nm": {5: 40.0, 8: -35.0, 12: 30.0}},
    "companion": {"flux_ratio": 0.2, "sep_mas": 90.0, "pa_deg": 300.0},
    "ghost": {"flux_ratio": 0.2, "sep_mas": 90.0, "pa_deg": 120.0, "defocus_nm": 90.0, "blur_mas": 10.0},
    "interpixel_crosstalk": {"fraction": 0.08},
    "detector_nonlinearity": {"fraction_at_peak": 0.06},
    "background_gradient": {"e_per_pixel": 4.0, "angle_deg": 30.0},
    "correlated_noise": {"e_rms": 3.0, "axis": "columns"},
    "bad_pixels": {"pixels": [[4, 7], [20, 21]]},
}


def conditions_of(name: str) -> Conditions:
    """Conditions under which the effect means something."""
    return LOW_CUTOFF if name == "ao_cutoff" else CONDITIONS


def made(name: str) -> tuple[Effect, torch.Tensor]:
    """The effect and the solver's parameters for its strong level."""
    public, kind = STRONG[name], CATALOGUE[name]
    effect = kind.under(conditions_of(name), **kind.options_for(**public))
    return effect, torch.tensor(effect.values_of(**public), dtype=torch.float64)


def affected(model: PsfModel, name: str, modes_nm: torch.Tensor) -> torch.Tensor:
    """Unit-flux images of `model` with the effect."""
    effect, values = made(name)
    return model.images(modes_nm, EffectSet([effect], model.grids)(values))
