"""Names of the effects a scene can contain, and of their parameters."""

from __future__ import annotations

from collections.abc import Mapping

from irlos_pipe.simulate.checks import SceneError, require_known

# Effect: (parameters it needs, parameters it may have). Names and units are those of models and reports;
# what a parameter means is told where the effect happens.
EFFECTS: dict[str, tuple[set[str], set[str]]] = {
    # during the exposure: shaking.py, atmosphere.py
    "tip_tilt_jitter": ({"sigma_mas"}, {"correlation_s"}),
    "vibration": ({"sigma_mas"}, {"angle_deg", "frequency_hz", "distribution"}),
    "seeing_halo": (set(), {"scale", "wfe_nm"}),
    # light: rays.py
    "atmospheric_dispersion": ({"mas_per_um"}, {"angle_deg"}),
    "spectrum": (set(), {"wavelength_nm", "slope", "weights"}),
    "plate_scale": ({"fraction"}, set()),
    "companion": ({"flux_ratio", "sep_mas", "pa_deg"}, set()),
    # pupil: telescope.py, petals.py
    "pupil_misregistration": (set(), {"dx_m", "dy_m", "rotation_deg"}),
    "amplitude_aberration": ({"zernike"}, set()),
    "low_wind_effect": (set(), {"piston_nm", "tip_nm", "tilt_nm"}),
    # wavefront: wavefront.py
    "high_order_ncpa": ({"zernike_nm"}, set()),
    "phase_bump": ({"nm", "x_m", "y_m", "width_m"}, set()),
    "ncpa_drift": ({"zernike_nm"}, set()),
    "diversity_error": ({"nm"}, set()),
    "focus_stage_hysteresis": ({"nm"}, {"scatter_nm", "direction"}),
    "focus_stage_offset": ({"nm"}, {"above_nm", "below_nm"}),
    "focus_stage_scale": ({"fraction"}, set()),
    # detector: pixels.py, late_defects.py
    "interpixel_crosstalk": ({"fraction"}, set()),
    "detector_nonlinearity": ({"fraction_at_peak"}, set()),
    "background_gradient": (set(), {"e_per_pixel", "angle_deg", "level_e"}),
    "bad_pixels": ({"pixels"}, {"kind", "level_e"}),
}


def check_effects(effects: Mapping[str, Mapping]) -> None:
    """Refuse unknown effects, unknown parameters and missing ones.

    Raises
    ------
    SceneError
        Naming the effect or parameter, and the nearest known name.
    """
    require_known("effects", effects, EFFECTS)
    for name, parameters in effects.items():
        needed, possible = EFFECTS[name]
        require_known(f"effects.{name}", parameters, sorted(needed | possible))
        missing = sorted(needed - set(parameters))
        if missing:
            raise SceneError(f"effects.{name}: {', '.join(missing)} must be given")
