"""Numbers of nights put into a trend database, without a reduction."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

from irlos_pipe.night.bands import Band, Point
from irlos_pipe.night.database import opened
from irlos_pipe.night.numbers import Measurements
from irlos_pipe.night.settings import BandSettings
from irlos_pipe.night.trend import make_trend

DAY_S = 86400.0
FIRST_S = 1707620400.0  # 2024-02-11 03:00 UTC, night of 2024-02-10


def night(day: int) -> str:
    return (datetime(2024, 2, 10, tzinfo=UTC) + timedelta(days=day)).date().isoformat()


def measured(key: str = "k", verdict: str | None = None, **numbers: float) -> Measurements:
    given = {name: (value, 0.5) for name, value in numbers.items()}
    return Measurements("ok", given, verdict, [], "irlos_pipe 1", key)


def put(tree: Path, day: int, content: Measurements, start: bool = True, recipe: str = "cube") -> str:
    run = f"{night(day)}/030000_cube/{recipe}"
    start_unix_s = FIRST_S + day * DAY_S if start else None
    with opened(tree) as database:
        database.store_run((run, night(day), "calibration", recipe, start_unix_s, "lens", "HD 1"), content)
    return run


def bands(nights, values, sigmas, rule: BandSettings) -> list[Band | None]:
    points = [
        Point("n/g/r", one, float(index), "defocus_bias_nm", "r", "", value, sigma)
        for index, (one, value, sigma) in enumerate(zip(nights, values, sigmas, strict=True))
    ]
    return [one.band for one in make_trend(points, (), rule).points]


def dates(count: int) -> list[str]:
    return [f"2024-{1 + i // 28:02d}-{1 + i % 28:02d}" for i in range(count)]
