"""From exposures to records: measurement, validity, controller. Knows neither files nor sockets."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field

from irlos_pipe.control.controller import ControllerSettings, ControllerState, Decision, decide
from irlos_pipe.control.exposures import Exposure
from irlos_pipe.control.response import Response
from irlos_pipe.estimate.focus.sensor import Measurement
from irlos_pipe.focus.calibration import Calibration
from irlos_pipe.focus.ordinary import MISFIT
from irlos_pipe.focus.record import FAILED, FROZEN, INCOMPLETE, LATE, OLD, SHADOW, STALE, WINDOW, Record
from irlos_pipe.focus.source import Clock

OPEN = "open"  # why an offset is held: nothing answers it
NUMBERS = ("defocus_nm", "tip_nm", "tilt_nm", "flux_e", "background_e", "chi2_nu", "misfit")


@dataclass(frozen=True)
class LoopSettings:
    """How a loop runs."""

    controller: ControllerSettings = field(default_factory=ControllerSettings)
    reads: int = 1  # added up to an exposure
    counter_step: int = 1  # of the recorder's counter, from one read to the next
    shadow: bool = False  # measure and record, command nothing
    stale_after_s: float = math.inf  # age of the calibration from which nothing is valid
    stale_frames_s: float = math.inf  # age of an exposure from which it is not used
    least_reads: float = 0.5  # part of an exposure's reads below which it is not used


class FocusLoop:
    """Makes a record of every exposure; goes on from the last record of an earlier start.

    `problem` says what was unforeseen in the last measurement, if anything was; `open` says how the focus
    answers the offsets, where the loop is not closed: from then on the offset is held.
    """

    def __init__(self, calibration: Calibration, settings: LoopSettings, last: Record | None = None):
        self.calibration, self._settings = calibration, settings
        self._state = ControllerState() if last is None else last.state
        self.sequence = 0 if last is None else last.sequence
        self.problem = self.open = ""
        self._response = Response(settings.controller.delay)
        self._last_index: int | None = None
        self._clock = Clock()

    def take_over(self, number: int, offset_nm: float) -> None:
        """Go on from a command, of a `number`, of which there is no record."""
        self.sequence, self._state = number, ControllerState(offset_nm)

    def record(
        self, exposure: Exposure, arrived_s: float, *, damaged: int = 0, overtaken: bool = False
    ) -> Record:
        """Measure an `exposure` and decide on the offset.

        Its last read arrived at `arrived_s` of the monotonic clock; so many reads before were `damaged`. One
        that a later exposure has `overtaken` is recorded and not used.
        """
        measured = self._judged(exposure, self._measured(exposure), overtaken)
        decision = self._decided(exposure, measured)
        self.sequence += 1
        state = decision.state
        return Record(
            sequence=self.sequence,
            exposure=exposure.index,
            counter=exposure.first_counter,
            unix_s=exposure.unix_s,
            reads=exposure.reads,
            reads_late=exposure.late,
            reads_doubled=exposure.doubled,
            reads_missing=exposure.missing,
            reads_damaged=damaged,
            **{name: getattr(measured, name) for name in NUMBERS},
            sigma_nm=self._sigma_nm(measured),
            sigma_photon_nm=measured.sigma_nm,
            valid=measured.valid,
            reasons=measured.reasons,
            mode=SHADOW if self._settings.shadow else state.mode,
            offset_nm=state.offset_nm,
            commanded=decision.commanded,
            held=decision.held,
            clipped=decision.clipped,
            settling=state.settling,
            outside=state.outside,
            latency_ms=(time.monotonic() - arrived_s) * 1e3,
            calibration=self.calibration.name,
            recording=exposure.recording,
            recorded_unix_s=time.time(),
        )

    def _measured(self, exposure: Exposure) -> Measurement:
        if exposure.image_e.shape != self.calibration.window:
            return Measurement(math.nan, math.nan, False, (WINDOW,))
        self.problem = ""
        try:
            return self.calibration.sensor.measurement(exposure.image_e, exposure.reads)
        except Exception as error:  # whatever stands in an image, the loop goes on
            logging.getLogger(__name__).debug("measurement", exc_info=True)
            self.problem = f"{type(error).__name__}: {error}"
            return Measurement(math.nan, math.nan, False, (FAILED,))

    def _sigma_nm(self, measured: Measurement) -> float:
        errors = self.calibration.errors
        if errors is None:
            return math.nan
        beside = measured.beside
        growth = (1.0, 0.0) if beside is None else self.calibration.ordinary.growth(beside)
        return errors.sigma_nm(measured.defocus_nm, measured.sigma_nm, *growth)

    def _judged(self, exposure: Exposure, measured: Measurement, overtaken: bool) -> Measurement:
        """With the reasons that the image does not show."""
        calibration, settings, beside = self.calibration, self._settings, measured.beside
        age_s = abs(exposure.unix_s - calibration.made_unix_s)  # NaN is never too old
        against = {
            MISFIT: beside is not None
            and not calibration.ordinary.fits(beside, calibration.sensor.limits.misfit),
            FROZEN: exposure.repeated > 0,
            OLD: not settings.shadow and self._clock.off_s(exposure.unix_s) > settings.stale_frames_s,
            LATE: overtaken,
            STALE: age_s > settings.stale_after_s,
            INCOMPLETE: exposure.reads < settings.least_reads * exposure.expected,
        }
        reasons = (*measured.reasons, *(reason for reason, holds in against.items() if holds))
        return measured._replace(valid=not reasons, reasons=reasons)

    def _decided(self, exposure: Exposure, measured: Measurement) -> Decision:
        if self._settings.shadow:
            return Decision(self._state, False)
        defocus_nm = measured.defocus_nm if measured.valid else None
        passed = 1 if self._last_index is None else max(1, exposure.index - self._last_index)
        self._last_index = exposure.index
        self.open = self.open or self._response.verdict(defocus_nm, self._state.offset_nm, passed)
        if self.open:
            return Decision(self._state, False, held=OPEN if measured.valid else "")
        decision = decide(self._state, defocus_nm, self._settings.controller)
        self._state = decision.state
        return decision
