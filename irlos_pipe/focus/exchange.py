"""A calibration is replaced while the loop runs: the new one is made ready and taken between exposures."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, field

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.focus.agreement import optical_differences
from irlos_pipe.focus.calibration import Calibration, CalibrationRequest
from irlos_pipe.product.runfolder import RunFolder

LOOK_S = 1.0


@dataclass(frozen=True)
class News:
    """A calibration that is ready, or the `problem` with one that is not used."""

    calibration: Calibration | None
    problem: str = ""


@dataclass
class CalibrationWatch:
    """Looks whether a run folder, or the link to one, has a new calibration.

    Attributes
    ----------
    request : CalibrationRequest
    current : Calibration
        In use.
    """

    request: CalibrationRequest
    current: Calibration
    _looked_s: float = field(default_factory=time.monotonic)
    _worker: threading.Thread | None = None
    _news: News | None = None

    def __post_init__(self) -> None:
        self._stamp = self._present_stamp()

    def news(self) -> News | None:
        """Return what has come since the last call."""
        if self._worker is not None and not self._worker.is_alive():
            self._worker = None
            found, self._news = self._news, None
            if found is not None and found.calibration is not None:
                self.current = found.calibration
            return found
        if self._worker is None and time.monotonic() - self._looked_s > LOOK_S:
            self._looked_s = time.monotonic()
            self._look()
        return None

    def _look(self) -> None:
        stamp = self._present_stamp()
        if stamp is None or stamp == self._stamp:
            return
        self._stamp = stamp
        self._worker = threading.Thread(target=self._load, daemon=True)
        self._worker.start()

    def _present_stamp(self) -> tuple[int, ...] | None:
        """Of the file that a run writes last; None where there is none."""
        try:
            stat = RunFolder(self.request.run).results.stat()
        except OSError:
            return None
        return stat.st_dev, stat.st_ino, stat.st_mtime_ns

    def _load(self) -> None:
        try:
            new = self.request.load()
            require_exchangeable(self.current, new)
        except IrlosError as error:
            self._news = News(None, " ".join(str(error).split()))
        except Exception as error:  # the loop goes on with what it has, whatever is wrong with the other
            logging.getLogger(__name__).debug("calibration", exc_info=True)
            self._news = News(None, f"{self.request.run}: cannot be used: {type(error).__name__}: {error}")
        else:
            self._news = News(new) if new.name != self.current.name else None


def require_exchangeable(old: Calibration, new: Calibration) -> None:
    """Refuse a `new` calibration that is not for the frames of the `old` one.

    Raises
    ------
    InputDataError
        Another instrument or window, or frames taken otherwise.
    """
    if new.instrument_name != old.instrument_name:
        raise InputDataError(
            f"{new.name}: a calibration of instrument {new.instrument_name}, "
            f"and the loop runs on {old.instrument_name}"
        )
    if new.window != old.window:
        raise InputDataError(
            f"{new.name}: a calibration for frames of {new.window[0]}x{new.window[1]} px, the loop has "
            f"{old.window[0]}x{old.window[1]}"
        )
    against = optical_differences(new.acquisition, old.acquisition)
    if against:
        raise InputDataError(
            f"{new.name}: a calibration for other frames than the loop has: {'; '.join(against)}"
        )
