"""Which recordings belong together: calibration cubes, the ramps they serve, series of derotator angles."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from itertools import pairwise

from irlos_pipe.night.description import Description, clock, common_depth

CALIBRATION, RAMP, DEROTATOR, PSF = KINDS = ("calibration", "ramp", "derotator", "psf")
NOT_SERVED = "no calibration cube of its configuration within {0} nights ({1})"
ONE_LENSLET = "images of a 2x2 mode; the model is that of the full pupil"
Offered = Mapping[str, tuple[Description, ...]]


@dataclass(frozen=True)
class Group:
    """Recordings that are reduced together.

    Attributes
    ----------
    kind : str
        ``calibration``, ``ramp``, ``derotator`` or ``psf``.
    name : str
        Of its folder, unique in the night; the same when recordings are added to it later.
    inputs : dict of str to tuple of Description
        What it offers to the inputs of a recipe, by the input's name.
    """

    kind: str
    night: str
    name: str
    inputs: Offered

    @property
    def first(self) -> Description:
        """The recording that stands for the group."""
        return next(iter(self.inputs.values()))[0]


@dataclass(frozen=True)
class LeftOut:
    """A recording of which nothing is made; `alarming` when somebody should know."""

    recording: Description
    reason: str
    alarming: bool = False


@dataclass(frozen=True)
class Grouping:
    """What becomes of the recordings."""

    groups: list[Group] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)


@dataclass(frozen=True)
class Rules:
    """What belongs together.

    Attributes
    ----------
    gap_s : float
        Longest time between the beginnings of two recordings of one series [s].
    nights : int
        A ramp may be served by a calibration of another night, so many nights away.
    """

    gap_s: float = 1800.0
    nights: int = 7


def group_recordings(
    found: Iterable[Description], rules: Rules | None = None, others: Iterable[Description] = ()
) -> Grouping:
    """Sort recordings into groups.

    A calibration cube is a group of its own. Recordings of a ramp are of one night, share configuration,
    spectrum, target and folder, and follow one another without a long pause; the ramp is served by a
    calibration of its configuration: of the same night, else of an earlier one, else of a later one, the
    nearest in time. Cubes of a derotator series share the same. Darks of the same night, mode and window
    go with every recording.

    Parameters
    ----------
    others : iterable of Description
        Further recordings, which may serve ramps but are not grouped themselves.
    """
    rules, found = rules or Rules(), list(found)
    own = {one.path for one in found}
    known = [*found, *(one for one in others if one.path not in own)]
    cubes = [one for one in known if one.role == "ncpa_calibration" and one.full_pupil]
    nights = _split(found, lambda one: one.night)
    grouping = Grouping()
    for night in sorted(nights):
        _group_night(sorted(nights[night], key=_in_time), cubes, rules, grouping)
    return grouping


def _group_night(
    found: Sequence[Description], cubes: Sequence[Description], rules: Rules, grouping: Grouping
) -> None:
    """Group the recordings of one night; `cubes` are those of all nights."""
    grouping.left_out.extend(LeftOut(one, ONE_LENSLET) for one in found if not one.full_pupil)
    roles = _split((one for one in found if one.full_pupil), lambda one: one.role)
    groups = [_single(CALIBRATION, cube) for cube in roles["ncpa_calibration"]]
    for ramp in _series(roles["defocus_ramp"], rules.gap_s):
        served = _serving(ramp[0], cubes, rules.nights)
        if served is None:
            reason = NOT_SERVED.format(rules.nights, ramp[0].configuration)
            grouping.left_out.extend(LeftOut(one, reason, alarming=True) for one in ramp)
        else:
            groups.append(_group(RAMP, ramp, ramp=ramp, calibration=(served,)))
    groups += [_group(DEROTATOR, series, cube=series) for series in _series(roles["derotator"], rules.gap_s)]
    groups += [_single(PSF, one) for one in roles["psf"]]
    grouping.groups.extend(_with_own_names(_with_darks(group, roles["dark"]) for group in groups))


def _group(kind: str, members: Sequence[Description], **inputs: tuple[Description, ...]) -> Group:
    return Group(kind, members[0].night, _name(members), inputs)


def _single(kind: str, cube: Description) -> Group:
    """A cube by itself; recipes call it by either name."""
    return _group(kind, (cube,), calibration=(cube,), cube=(cube,))


def _series(found: Sequence[Description], gap_s: float) -> Iterator[tuple[Description, ...]]:
    """Split recordings, in order of time, into series."""
    alike = _split(found, lambda one: (one.configuration, one.spectrum, one.target, one.path.parent))
    for members in alike.values():
        steps = enumerate(pairwise(members), 1)
        ends = [place for place, (one, other) in steps if _apart_s(one, other) > gap_s]
        for start, end in pairwise((0, *ends, len(members))):
            yield tuple(members[start:end])


def _serving(ramp: Description, cubes: Iterable[Description], nights: int) -> Description | None:
    """The calibration that serves a ramp. Earlier nights come before later ones, which are not known yet
    on the morning after: what is found then stays the choice."""
    fitting = [
        cube
        for cube in cubes
        if cube.configuration == ramp.configuration and abs(_nights_apart(cube, ramp)) <= nights
    ]
    return min(fitting, key=lambda cube: _preference(cube, ramp), default=None)


def _preference(cube: Description, ramp: Description) -> tuple:
    """The lower the better."""
    apart = _nights_apart(cube, ramp)
    depth = common_depth(cube.path, ramp.path)
    return (apart != 0, apart > 0, abs(apart), _apart_s(cube, ramp), -depth, str(cube.path))


def _nights_apart(one: Description, other: Description) -> int:
    return (date.fromisoformat(one.night) - date.fromisoformat(other.night)).days


def _apart_s(one: Description, other: Description) -> float:
    """Time between two recordings [s]; none when it is not known: then nothing speaks against them."""
    if one.start_unix_s is None or other.start_unix_s is None:
        return 0.0
    return abs(one.start_unix_s - other.start_unix_s)


def _with_darks(group: Group, darks: Sequence[Description]) -> Group:
    """Add to every input the darks that ingest may take for it."""
    inputs = {
        name: (*members, *(dark for dark in darks if _fits(dark, members[0])))
        for name, members in group.inputs.items()
    }
    return Group(group.kind, group.night, group.name, inputs)


def _fits(dark: Description, recording: Description) -> bool:
    return (dark.window, dark.mode) == (recording.window, recording.mode)


def _name(members: Sequence[Description]) -> str:
    """Time and name of the first; of a series in a folder of its own, the name of that folder."""
    first = members[0]
    plain = re.sub(r"[^\w.+-]+", "_", first.path.parent.name if len(members) > 1 else first.name).strip("._")
    return "_".join(filter(None, [clock(first.start_unix_s, "%H%M%S"), plain])) or "recording"


def _with_own_names(groups: Iterable[Group]) -> Iterator[Group]:
    """Number groups that would share a folder."""
    taken: dict[str, int] = defaultdict(int)
    for group in groups:
        taken[group.name] += 1
        number = taken[group.name]
        yield group if number == 1 else Group(group.kind, group.night, f"{group.name}-{number}", group.inputs)


def _in_time(one: Description) -> tuple:
    """In order of time, those without a time first."""
    return (one.start_unix_s is not None, one.start_unix_s or 0.0, str(one.path))


def _split(found: Iterable[Description], key: Callable[[Description], Hashable]) -> dict:
    parts: dict[Hashable, list[Description]] = defaultdict(list)
    for one in found:
        parts[key(one)].append(one)
    return parts
