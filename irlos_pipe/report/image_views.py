"""Images and residuals in several ways: linear and logarithmic, in σ and in per cent of the peak."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from irlos_pipe.report.content import Figure, Views, Width
from irlos_pipe.report.images import (
    SIGMA_LIMIT,
    SIGNED,
    brightness_scale,
    image_panel,
    linear_scale,
    symmetric_scale,
)

PERCENTILE = 99.8  # of residuals, for the end of their scale: single pixels would swallow it
LINEAR_SIGMA = 2.0  # within which an asinh scale of residuals is linear: what is noise
ELECTRONS = "e⁻"


def image_views(
    name: str,
    images: Mapping[str, tuple[np.ndarray, str]],
    pixel_scale_mas: float | None,
    good: np.ndarray | None = None,
    width: Width = "full",
) -> Views:
    """Return images on one scale, asinh or linear.

    Parameters
    ----------
    name : str
        Unique in the page.
    images : mapping
        By title: image (rows, columns) [e-], and a caption.
    pixel_scale_mas : float or None
    good : ndarray of bool, optional
        Pixels that are False get a cross in the first image.
    width : Width
        Of all together.
    """
    first = next(iter(images))
    scales = {"logarithmic": brightness_scale, "linear": linear_scale}
    choices = {}
    for label, scale_of in scales.items():
        scale = scale_of(*(image for image, _ in images.values()))
        choices[label] = [
            Figure(
                image_panel(
                    f"{name}-{label}-{number}",
                    image,
                    scale,
                    pixel_scale_mas,
                    ELECTRONS,
                    good=good if title == first else None,
                ),
                title,
                caption,
                "third",
            )
            for number, (title, (image, caption)) in enumerate(images.items())
        ]
    return Views(name, choices, width)


def residual_views(
    name: str,
    residuals: Mapping[str, tuple[np.ndarray, str]],
    sigma_e: np.ndarray | None,
    peak_e: float,
    pixel_scale_mas: float | None,
    width: Width = "full",
) -> Views:
    """Return residuals on one scale: in σ and in per cent of the peak, asinh and linear.

    Parameters
    ----------
    name : str
        Unique in the page.
    residuals : mapping
        By title: measured minus predicted (rows, columns) [e-], and a caption.
    sigma_e : ndarray or None, (rows, columns)
        Standard errors, 0 or not finite where a pixel is not used; without them there are no σ.
    peak_e : float
        Of the predicted image.
    pixel_scale_mas : float or None
    width : Width
        Of all together.
    """
    percent = np.array(100 / peak_e if peak_e > 0 else np.nan)
    units = {} if sigma_e is None else {"σ": (in_sigma(sigma_e), SIGMA_LIMIT)}
    units |= {"% of the peak": (percent, 0.0)}
    choices: dict[str, list[Figure]] = {}
    for unit, (factor, least) in units.items():
        shown = {title: (residual * factor, caption) for title, (residual, caption) in residuals.items()}
        limit = max(least, *(_limit(image) for image, _ in shown.values()))
        linear_width = LINEAR_SIGMA if unit == "σ" else limit / 100
        for label, scale in (
            ("log", symmetric_scale(limit, linear_width)),
            ("linear", symmetric_scale(limit)),
        ):
            choices[f"{unit[0]} {label}"] = [
                Figure(
                    image_panel(
                        f"{name}-{len(choices)}-{number}", image, scale, pixel_scale_mas, unit, SIGNED
                    ),
                    title,
                    caption,
                    "third",
                )
                for number, (title, (image, caption)) in enumerate(shown.items())
            ]
    return Views(name, choices, width)


def in_sigma(sigma_e: np.ndarray) -> np.ndarray:
    """Return one over the standard errors, NaN where a pixel is not used."""
    used = np.isfinite(sigma_e) & (sigma_e > 0)
    return np.where(used, 1 / np.where(used, sigma_e, 1.0), np.nan)


def _limit(image: np.ndarray) -> float:
    values = np.abs(image[np.isfinite(image)])
    return (float(np.percentile(values, PERCENTILE)) if values.size else 0.0) or 1e-3
