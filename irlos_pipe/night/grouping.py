"""Which recordings are reduced together: calibration cubes, ramps and their calibration, derotator series."""

import hashlib
import re
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from itertools import pairwise
from typing import TypeVar

from irlos_pipe.night.recordings import Description, LeftOut, common_depth, utc_time
from irlos_pipe.night.settings import Kind, NightSettings

NO_CALIBRATION = "no calibration cube of its configuration within {0} nights ({1})"
NONE_PASSED = (
    "no calibration cube of its configuration within {0} nights passed its quality check; nearest: {1}"
)
MAX_NAME_BYTES = 100
OTHER_2X2 = "a 2x2 mode with role {0}; night reduces those of role psf"
Inputs = Mapping[str, tuple[Description, ...]]
Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Group:
    """Recordings that are reduced together."""

    kind: Kind  # ``calibration``, ``ramp``, ``derotator``, ``psf`` or ``two_by_two``
    night: str
    name: str  # name of its folder, unique in the night; it stays when recordings are added later
    inputs: Inputs  # recordings for the inputs of a recipe, by the input's name
    choice: str = ""  # which calibration a ramp is given, and why

    @property
    def first(self) -> Description:
        return next(iter(self.inputs.values()))[0]


def group_recordings(
    found: Iterable[Description],
    settings: NightSettings,
    others: Iterable[Description] = (),
    failed: Mapping[str, str] | None = None,
) -> tuple[list[Group], list[LeftOut]]:
    """Sort recordings into groups; returns these, and the recordings that are in none.

    A calibration cube is a group of its own. Recordings of a ramp are of one night, share configuration,
    spectrum, target and folder, and follow one another without a long pause. A ramp uses a calibration of
    its configuration that has not failed: of the same night, else of an earlier one, else of a later one; of
    one night that of its spectrum, and the nearest in time.
    Cubes of a derotator series share the same properties as those of a ramp. Darks of the same night, mode
    and window are added to every input.

    The `settings` say how long a pause and how many nights away a calibration may be. What was `found` is
    grouped; `others` may calibrate ramps; `failed` says why calibrations failed, by `cube_key`.
    """
    found = list(found)
    own = {one.path for one in found}
    further = [one for one in others if one.path not in own]
    known = [*found, *(one for one in further if not any(one.same_frames(mine) for mine in found))]
    cubes = [one for one in known if one.role == "ncpa_calibration" and one.full_pupil]
    groups: list[Group] = []
    left_out: list[LeftOut] = []
    for _, members in sorted(_split(found, lambda one: one.night).items()):
        in_order = sorted(members, key=_by_time)
        darks = [one for one in in_order if one.role == "dark"]
        of_night = _of_night(in_order, cubes, settings, left_out, failed or {})
        groups += _with_unique_names(_with_darks(group, darks) for group in of_night)
    return groups, left_out


def _of_night(
    found: Sequence[Description],
    cubes: Sequence[Description],
    settings: NightSettings,
    left_out: list[LeftOut],
    failed: Mapping[str, str],
) -> Iterator[Group]:
    """Group the recordings of one night; `cubes` are those of all nights."""
    lenslets = [one for one in found if not one.full_pupil]
    others = [one for one in lenslets if one.role not in ("psf", "dark")]
    left_out.extend(LeftOut(one, OTHER_2X2.format(one.role)) for one in others)
    roles = _split((one for one in found if one.full_pupil), lambda one: one.role)
    gap_s = 60 * settings.series_gap_min
    yield from (_single("calibration", cube) for cube in roles["ncpa_calibration"])
    for ramp in _series(roles["defocus_ramp"], gap_s):
        calibration, why = _calibration_for(ramp[0], cubes, settings.calibration_nights, failed)
        if calibration is None:
            left_out.extend(LeftOut(one, why, alarming=True) for one in ramp)
        else:
            yield replace(_group("ramp", ramp, ramp=ramp, calibration=(calibration,)), choice=why)
    yield from (_group("derotator", series, cube=series) for series in _series(roles["derotator"], gap_s))
    yield from (_single("psf", one) for one in roles["psf"])
    yield from (_single("two_by_two", one) for one in lenslets if one.role == "psf")


def _group(kind: Kind, members: Sequence[Description], **inputs: tuple[Description, ...]) -> Group:
    return Group(kind, members[0].night, _name(members), inputs)


def _single(kind: Kind, cube: Description) -> Group:
    """A cube by itself; recipes call it by either name."""
    return _group(kind, (cube,), calibration=(cube,), cube=(cube,))


def _series(found: Sequence[Description], gap_s: float) -> Iterator[tuple[Description, ...]]:
    """Split recordings, in order of time, into series."""
    same_setup = _split(found, lambda one: (one.configuration, one.spectrum, one.target, one.path.parent))
    for members in same_setup.values():
        steps = enumerate(pairwise(members), 1)
        ends = [index for index, (one, other) in steps if _apart_s(one, other) > gap_s]
        for start, end in pairwise((0, *ends, len(members))):
            yield tuple(members[start:end])


def cube_key(cube: Description) -> str:
    """Return the name of a cube's group in the tree: ``<night>/<group>``."""
    return f"{cube.night}/{_name((cube,))}"


def _calibration_for(
    ramp: Description, cubes: Iterable[Description], nights: int, failed: Mapping[str, str]
) -> tuple[Description | None, str]:
    """The calibration of a ramp, if there is one, and why it is that or there is none.

    Earlier nights are preferred to later ones, which do not exist yet on the morning after: so the choice
    stays when they do.
    """
    fitting = [cube for cube in cubes if cube.configuration == ramp.configuration]
    fitting = [cube for cube in fitting if abs(_nights_apart(cube, ramp)) <= nights]
    fitting.sort(key=lambda cube: _preference(cube, ramp))
    reasons: list[str] = []
    for cube in fitting:
        why = failed.get(cube_key(cube))
        if why is None:
            return cube, _choice(cube, ramp, reasons)
        reasons.append(f"{cube.name}: {why}")
    if reasons:
        return None, NONE_PASSED.format(nights, reasons[0])
    return None, NO_CALIBRATION.format(nights, ramp.configuration)


def _choice(cube: Description, ramp: Description, nearer: Sequence[str]) -> str:
    """Which calibration, how far from the ramp it is, and what spoke against nearer ones."""
    distance, apart = "of the same night", _nights_apart(cube, ramp)
    if apart:
        distance = f"{abs(apart)} night{'s' if abs(apart) > 1 else ''} {'later' if apart > 0 else 'earlier'}"
    elif cube.start_unix_s is not None and ramp.start_unix_s is not None:
        distance = f"{_apart_s(cube, ramp) / 60:.0f} min away"
    instead = f"; not {', not '.join(nearer)}" if nearer else ""
    return f"{cube.name}, {distance}, the nearest that has not failed{instead}"


def _preference(cube: Description, ramp: Description) -> tuple[bool, bool, int, bool, float, int, str]:
    """Sort key; the smallest is preferred. Filters have wavefronts of their own."""
    apart = _nights_apart(cube, ramp)
    depth = common_depth(cube.path, ramp.path)
    other_band = cube.spectrum != ramp.spectrum
    return apart != 0, apart > 0, abs(apart), other_band, _apart_s(cube, ramp), -depth, str(cube.path)


def _nights_apart(one: Description, other: Description) -> int:
    return (date.fromisoformat(one.night) - date.fromisoformat(other.night)).days


def _apart_s(one: Description, other: Description) -> float:
    """Time between two recordings [s]; 0 when it is not known, so that it separates nothing."""
    if one.start_unix_s is None or other.start_unix_s is None:
        return 0.0
    return abs(one.start_unix_s - other.start_unix_s)


def _with_darks(group: Group, darks: Sequence[Description]) -> Group:
    """Add to every input the darks that ingest may use for it."""
    fitting = {
        name: [dark for dark in darks if (dark.window, dark.mode) == (members[0].window, members[0].mode)]
        for name, members in group.inputs.items()
    }
    return replace(group, inputs={name: (*group.inputs[name], *some) for name, some in fitting.items()})


def _name(members: Sequence[Description]) -> str:
    """Time and name of the first; of a series in a folder of its own, the name of that folder."""
    first = members[0]
    plain = re.sub(r"[^\w.+-]+", "_", first.path.parent.name if len(members) > 1 else first.name).strip("._")
    return "_".join(filter(None, [utc_time(first.start_unix_s, "%H%M%S"), _short(plain)])) or "recording"


def _short(name: str) -> str:
    """The name, or its beginning and a checksum: file systems take 255 bytes, with what is added to it."""
    content = name.encode()
    if len(content) <= MAX_NAME_BYTES:
        return name
    return f"{content[:MAX_NAME_BYTES].decode(errors='ignore')}-{hashlib.sha256(content).hexdigest()[:8]}"


def _with_unique_names(groups: Iterable[Group]) -> Iterator[Group]:
    """Number groups that would share a folder."""
    taken: dict[str, int] = defaultdict(int)
    for group in groups:
        taken[group.name] += 1
        number = taken[group.name]
        yield group if number == 1 else replace(group, name=f"{group.name}-{number}")


def _by_time(one: Description) -> tuple[bool, float, str]:
    """Sort key: by time, those without a time first."""
    return (one.start_unix_s is not None, one.start_unix_s or 0.0, str(one.path))


def _split(found: Iterable[Description], key: Callable[[Description], Key]) -> dict[Key, list[Description]]:
    parts: dict[Key, list[Description]] = defaultdict(list)
    for one in found:
        parts[key(one)].append(one)
    return parts
