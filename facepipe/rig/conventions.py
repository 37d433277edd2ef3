"""Names of shapes elsewhere, the shapes of a face that they mean however they are written, and renaming.

The tables are in ``conventions.json``, each with its source. A convention lists what its names mean, and for each
meaning the name that it writes and others that are read as well, the better first. A meaning is the ARKit shape, where
there is one; half or a quarter of one is called so (``mouthFunnelUpperLeft``).

A name is read in three ways, the closest first: as it is; without the namespace before it; without all that tools put
around names. Where several shapes of a mesh mean the same, the closest has the name, and none of equals.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean

if TYPE_CHECKING:
    from facepipe.parts import Animation, FaceParts, Mesh, Slider

_SIDES = {"l": "left", "left": "left", "左": "left", "r": "right", "right": "right", "右": "right"}
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[左右]|[^\W\d_A-Za-z左右]+")
_NAMESPACES = re.compile(r"[.:|]|__|^!ex-")  # blendShape1.jawOpen, face:jawOpen, MPFB's !ex-jawOpen
_PREFIXES = re.compile(
    r"^(?:[A-Z]?\d+[_ .-]+"  # A25_Jaw_Open, 23_jawDrop
    r"|(?:bs|bls|blend[ _]?shapes?|vrc)\d*[_ .-]+"  # BS_jawOpen
    r"|facs_(?:bs_|jnt_|ctrl_)?|ctrl_expressions_|xr_face_expression2?_"  # Daz, MetaHuman, OpenXR
    r"|.+(?=(?:fcl|facs)_))",  # M_F00_000_00_Fcl_MTH_A of VRoid
    re.IGNORECASE,
)
_SUFFIXES = re.compile(
    r"(?:\.\d{3}|_ncl\d+_\d+"  # Blender's and FBX's second of a name; jawOpen_2 is another shape
    r"|[ _-]copy\d*|[ _]?\(\d+\)|_div2|_fb|[ _.-](?:mesh|geo|shape|bs|blendshape|lod)\d*)$",
    re.IGNORECASE,
)
_MOST_AROUND = 8  # prefixes and suffixes of a name
_BREAKS = re.compile(r"(?<=[ _.:|-])(?=[^ _.:|-])|(?<=[a-z0-9])(?=[A-Z])")  # where words begin
_NOT_THAT = re.compile(r"(?<![a-z])(?:corr|fix|combo|inv|neg|minus|not?(?![a-z]))", re.IGNORECASE)  # corrective_jawOpen
_MOST_BREAKS = 8  # of what all names of a mesh begin with
_SAMPLE = 512  # names that this is tried on
_PARTS = (  # that a shape is split into
    ("left", "right"),
    ("upper", "lower"),
    ("upperleft", "upperright", "lowerleft", "lowerright"),
)
_TO_A_SIDE = {"jaw", "mouth", "look", "head", "tongue"}  # whose left and right are ways, not halves
_FEWEST_NAMES = 3  # names that make a convention
_CACHED = 1 << 14


@dataclass(frozen=True)
class Convention:
    """One table: what its names mean."""

    title: str
    source: str
    names: Mapping[str, tuple[str, ...]]  # meaning -> the name that is written, then others that are read

    @cached_property
    def written(self) -> dict[str, str]:
        """Meaning -> the name that it has here."""
        return {meaning: names[0] for meaning, names in self.names.items()}

    @cached_property
    def keys(self) -> dict[str, str]:
        """Key of each name -> its meaning."""
        return {shape_key(name): meaning for meaning, names in self.names.items() for name in names}


def _tables() -> dict[str, Convention]:
    read = json.loads(files("facepipe.rig").joinpath("conventions.json").read_text(encoding="utf-8"))
    for table in read.values():
        table["names"] = {meant: tuple(given) for meant, given in table["names"].items()}
    return {kind: Convention(table["title"], table["source"], table["names"]) for kind, table in read.items()}


@lru_cache(_CACHED)
def shape_key(name: str) -> str:
    """`name` without case, width and breaks, its side as a word at the end: ``eyeBlink_L`` is ``L_eye_blink``.

    >>> shape_key("eyeBlink_L"), shape_key("Left Eye Blink"), shape_key("EYEBLINKLEFT")
    ('eyeblinkleft', 'eyeblinkleft', 'eyeblinkleft')
    """
    words = [word.casefold() for word in _WORDS.findall(unicodedata.normalize("NFKC", name))]
    sides = [number for number, word in enumerate(words) if word in _SIDES]
    if len(sides) == 1 and len(words) > 1:
        words.append(_SIDES[words.pop(sides[0])])
    joined = "".join(words)
    for side in ("left", "right") if not sides else ():
        if joined.startswith(side) and joined != side:
            return joined.removeprefix(side) + side
    return joined or name


def _without_namespace(name: str) -> str:
    """``jawOpen`` of ``blendShape1.jawOpen``, ``eyeBlink.L`` of ``face:eyeBlink.L``; a name that has none as it is."""
    parts = [part for part in _NAMESPACES.split(name) if part]
    sided = len(parts) > 1 and parts[-1].casefold() in _SIDES
    return ".".join(parts[-2:] if sided else parts[-1:]) or name


@lru_cache(_CACHED)
def spelling(name: str) -> str:
    """The key of `name` without the namespace before it (``blendShape1.jawOpen``, ``face:jawOpen``)."""
    return shape_key(_without_namespace(name))


@lru_cache(_CACHED)
def _bare(name: str) -> str:
    """The key of `name` without what tools put around it: ``A25_Jaw_Open``, ``Genesis9__facs_bs_JawOpen_ncl1_1``.

    >>> _bare("A25_Jaw_Open"), _bare("BS_head.eyeBlink.L.001"), _bare("jawOpen_2")
    ('jawopen', 'eyeblinkleft', 'jawopen2')
    """
    text = unicodedata.normalize("NFKC", name)
    for _ in range(_MOST_AROUND):
        shorter = _PREFIXES.sub("", _without_namespace(_SUFFIXES.sub("", text)))
        if shorter in ("", text):
            break
        text = shorter
    return shape_key(text)


_READS: tuple[Callable[[str], str], ...] = (shape_key, spelling, _bare)


def _meanings() -> dict[str, tuple[str, int]]:
    """Key -> what it means, and the place of the name among those of its meaning: 0 is the meaning itself."""
    found: dict[str, tuple[str, int]] = {}
    for read in _READS:
        for table in CONVENTIONS.values():
            for meant, names in table.names.items():
                found.setdefault(shape_key(meant), (meant, 0))
                for place, name in enumerate(names, 1):
                    found.setdefault(read(name), (meant, place))
    return found


CONVENTIONS: Mapping[str, Convention] = _tables()
_MEANINGS = _meanings()
ARKIT_SHAPES = frozenset(CONVENTIONS["arkit"].written)


def _found(name: str) -> tuple[str | None, tuple[int, int]]:
    """The meaning of a name, and how close it is: (way that it was read, place in its table), smaller is closer."""
    for way, read in enumerate(_READS):
        if (known := _MEANINGS.get(read(name))) is not None:
            return known[0], (way, known[1])
    return None, (3, 0)


def meaning(name: str) -> str | None:
    """The meaning of a shape's name in any convention; None where it has none.

    >>> meaning("blendShape1.EyeBlink_L"), meaning("A25_Jaw_Open"), meaning("noseHump")
    ('eyeBlinkLeft', 'jawOpen', None)
    """
    return _found(name)[0]


def _meant(name: str) -> str:
    """The key of what a name means; nothing that any shape means where it means nothing."""
    found = meaning(name)
    return f"?{name}" if found is None else shape_key(found)


def _own(names: Sequence[str]) -> dict[str, str]:
    """Name -> the same without the words that all names of a mesh begin with, where more of them mean something then.

    ``Wolf3D_Head_jawOpen`` is ``jawOpen``, if all shapes of that mesh are called so. One alone may as well be a
    corrective, as ``jawOpen_mouthClose`` is: words that are cut off mean no shape themselves.
    """
    first, last = (min(names), max(names)) if names else ("", "")
    ends = (at for at, (one, other) in enumerate(zip(first, last, strict=False)) if one != other)
    shared = first[: next(ends, min(len(first), len(last)))]
    some = {name: meaning(name) for name in names[:_SAMPLE]}
    # fewer than make a convention, if each of them means something: teeth have two or three shapes
    fewest = max(2, min(len(some), _FEWEST_NAMES))
    best, most = 0, max(sum(meant is not None for meant in some.values()), fewest - 1)
    starts = [0, *(match.start() for match in _BREAKS.finditer(first))][: _MOST_BREAKS + 1]
    for at in starts[1:]:
        before = [first[start:at].strip(" _.:|-") for start in starts if start < at]
        if at > len(shared) or _NOT_THAT.search(before[0]) or any(len(one) > 1 and meaning(one) for one in before):
            break
        cut = {name: meaning(name[at:]) for name in some}
        kept = all(meant in (None, cut[name]) for name, meant in some.items())
        if kept and (count := sum(meant is not None for meant in cut.values())) > most:
            best, most = at, count
    return {name: name[best:] for name in names}


def shapes_of(meshes: Iterable[Mesh]) -> list[list[str]]:
    """The names of the shapes of each mesh."""
    return [[shape.name for shape in mesh.blendshapes] for mesh in meshes]


def _by_mesh(shapes: Sequence[str], meshes: Sequence[Sequence[str]]) -> list[dict[str, str]]:
    """For each mesh, and last for what no mesh has: shape -> its name without what all of them begin with."""
    wanted = set(shapes)
    groups = [[shape for shape in dict.fromkeys(mesh) if shape in wanted] for mesh in meshes]
    rest = wanted.difference(*groups)
    return [_own(group) for group in (*groups, [shape for shape in shapes if shape in rest])]


def _closest(read: Callable[[str], str], group: Mapping[str, str]) -> dict[str, str]:
    """Text that `read` makes of the shapes of a mesh -> the shape that is closest to it; without those of equals."""
    found: dict[str, list[tuple[tuple[int, int], str]]] = {}
    for shape, called in group.items():
        found.setdefault(read(called), []).append((_found(called)[1], shape))
    ranked = {text: sorted(every) for text, every in found.items()}
    return {text: one[0][1] for text, one in ranked.items() if len(one) == 1 or one[0][0] < one[1][0]}


def _split(key: str, parts: Sequence[str]) -> list[str]:
    """The keys of a shape's parts: ``mouthpressupperleft`` and ``mouthpresslowerleft`` of ``mouthpressleft``."""
    if not parts:
        return [key]
    if "left" in parts and key in _TO_A_SIDE:
        return []
    side = next((side for side in ("left", "right") if key.endswith(side)), "")
    return [key.removesuffix(side) + part + side for part in parts]


def match_shapes(
    names: Iterable[str], shapes: Sequence[str], meshes: Sequence[Sequence[str]] = ()
) -> dict[str, tuple[str, ...]]:
    """The face's shapes that incoming names mean; names that mean none are left out.

    A shape of that very name comes first, then the one that differs in case, breaks or the form of its side alone, then
    in namespace, then in what tools put around names, then the one that means the same in another convention. A name
    means all parts where the face has the shape in halves or quarters alone. No shape is given to two names: the
    better match has it. On each mesh a name has a shape of its own: ``head.jawOpen`` and ``teeth.jawOpen`` are one.

    >>> match_shapes(("JawOpen", "eyeBlink_L", "cheekPuff"), ("jawOpen", "blinkLeft", "cheekPuff_L", "cheekPuff_R"))
    {'JawOpen': ('jawOpen',), 'eyeBlink_L': ('blinkLeft',), 'cheekPuff': ('cheekPuff_L', 'cheekPuff_R')}

    :param shapes: also sliders, of no mesh: a name means these or shapes, not both
    :param meshes: the shapes of each mesh; none: all shapes are of one
    """
    incoming = list(dict.fromkeys(names))
    groups = _by_mesh(shapes, meshes)
    matched: dict[str, tuple[str, ...]] = {name: (name,) for name in incoming if name in {*shapes}}
    taken = set(matched)
    served = {name: {number for number, group in enumerate(groups) if name in group} for name in incoming}
    homes: dict[str, set[int]] = {}
    for number, group in enumerate(groups):
        for shape in group:
            homes.setdefault(shape, set()).add(number)
    called = _own(incoming)
    place = {name: number for number, name in enumerate(incoming)}
    ways = [(read, [_closest(read, group) for group in groups]) for read in (*_READS, _meant)]
    # form by form over all names, not name by name: a loose match never takes the shape that a later name spells
    for parts in ((), *_PARTS):
        for read, indices in ways:
            keys = {name: _split(read(text), parts) for name, text in called.items()}
            by_first: dict[str, list[str]] = {}
            for name, own in keys.items():
                by_first.setdefault(own[0] if own else "", []).append(name)
            for number, index in enumerate(indices):
                no_mesh = number == len(groups) - 1
                # of all names on each mesh: thousands on hundreds of meshes took half a minute
                near = (name for key in index.keys() & by_first.keys() for name in by_first[key])
                for name in sorted(near, key=place.__getitem__):
                    # a slider that means the same as a shape would move it twice
                    if served[name] if no_mesh else served[name] & {number, len(groups) - 1}:
                        continue
                    meant = tuple(index[key] for key in keys[name] if key in index)
                    elsewhere = any(not served[name].isdisjoint(homes[shape]) for shape in meant)
                    if meant and len(meant) == len(keys[name]) and not elsewhere and not taken.intersection(meant):
                        matched[name] = (*matched.get(name, ()), *meant)
                        taken.update(meant)
                        served[name].add(number)
    return {name: matched[name] for name in incoming if name in matched}


def _counts(called: Sequence[str]) -> dict[str, tuple[int, int, set[str]]]:
    """Convention -> how many meanings it has of the names, how many of these as they are, and the names.

    A convention that shares all these names with others above it is left out: MPFB's are ARKit's and Oculus's.
    """
    above: set[str] = set()
    counts = {}
    for kind, table in CONVENTIONS.items():
        found = {name: [key for read in _READS if (key := read(name)) in table.keys] for name in called}
        known = {name: keys for name, keys in found.items() if keys}
        as_they_are = sum(keys[0] in (shape_key(name), spelling(name)) for name, keys in known.items())
        if any(keys[0] not in above for keys in known.values()):
            counts[kind] = (len({table.keys[keys[0]] for keys in known.values()}), as_they_are, set(known))
        above.update(table.keys)
    return counts


def _all_recognised(shapes: Sequence[str], meshes: Sequence[Sequence[str]]) -> list[tuple[str, int]]:
    """The conventions that a face follows, each with how many names: the first has most of them, others half of theirs
    at least among the names that are left."""
    left = [called for group in _by_mesh(shapes, meshes) for called in group.values()]
    kinds: list[tuple[str, int]] = []
    while True:
        counts = _counts(left)
        fewest = [max(_FEWEST_NAMES, len(CONVENTIONS[kind].names) / 2 if kinds else 0) for kind in counts]
        counts = {kind: counts[kind] for kind, least in zip(counts, fewest, strict=True) if counts[kind][0] >= least}
        if not counts:
            return kinds
        kind = max(counts, key=lambda one: counts[one][:2])
        kinds.append((kind, counts[kind][0]))
        left = [name for name in left if name not in counts[kind][2]]


def recognised(shapes: Sequence[str], meshes: Sequence[Sequence[str]] = ()) -> tuple[str, int] | None:
    """The convention that most of `shapes` follow, and how many do, whatever their spelling; None for fewer than
    three names."""
    return next(iter(_all_recognised(shapes, meshes)), None)


def convention_names(kind: str, shapes: Sequence[str], meshes: Sequence[Sequence[str]] = ()) -> dict[str, str]:
    """Shape -> its name in a convention, of those that have another there.

    Of several shapes of a mesh that mean the same, the closest has the name; shapes of different meshes may share it.

    >>> convention_names("vrm", ("eyeBlink_L", "viseme_aa", "noseHump"))
    {'eyeBlink_L': 'blinkLeft', 'viseme_aa': 'aa'}
    """
    groups = _by_mesh(shapes, meshes)
    wanted = {shape: name for group in groups for shape, name in _wanted(kind, group) if shape != name}
    lost = {*unnamed(kind, shapes, meshes)}
    return {shape: wanted[shape] for shape in shapes if shape in wanted and shape not in lost}


def _wanted(kind: str, group: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    written = CONVENTIONS[kind].written
    for shape, called in group.items():
        name = written.get(meaning(called) or "")
        if name is not None:
            yield shape, name


def unnamed(kind: str, shapes: Sequence[str], meshes: Sequence[Sequence[str]] = ()) -> list[str]:
    """Shapes that mean a name of a convention that a closer shape of their mesh has, or none of several equals."""
    lost = set()
    for group in _by_mesh(shapes, meshes):
        wanted = dict(_wanted(kind, group))
        own = {shape for shape, name in wanted.items() if shape == name}
        closest = {*_closest(_meant, group).values()}
        count = Counter(wanted.values())
        lost |= {
            shape
            for shape, name in wanted.items()
            if count[name] > 1 and shape not in own and (shape not in closest or name in own)
        }
    return [shape for shape in shapes if shape in lost]


def unknown_names(parts: FaceParts, names: Mapping[str, str]) -> str | None:
    """A line about the names of a table that neither shapes nor joints of the face have; None where there are none."""
    known = [*parts.shapes, *parts.skeleton.names, *parts.skeleton.joints]
    missing = sorted({*names} - {*known})
    if not missing:
        return None
    example = f"such as '{missing[0][:60]}'{did_you_mean(missing[0], known)}"
    return f"{len(missing)} of {len(names)} names are not on the face, {example}"


def renamed(parts: FaceParts, names: Mapping[str, str], where: object) -> FaceParts:
    """The face whose shapes and joints have the new names of a table, in clips, sliders and their network too.

    Joint paths stay as they are: what changes are the names that files are written with. Shapes of different meshes
    that get one name are one control from then on.

    :param names: old name -> new one; of joints the source's name or the path
    :param where: the table, for messages
    :raises InputError: two shapes of a mesh, or two joints, that would have one name; or shapes that would be one
        control, but that a clip, a slider or the network moves differently
    """
    for shapes in shapes_of(parts.meshes):
        _check(where, "shapes", shapes, _all(shapes, names))
    meshes = []
    for mesh in parts.meshes:
        blendshapes = (
            replace(shape, name=names[shape.name], label=None) if shape.name in names else shape
            for shape in mesh.blendshapes
        )
        meshes.append(replace(mesh, blendshapes=tuple(blendshapes)))
    skeleton = parts.skeleton
    joint_names = [
        names.get(joint, names.get(path, joint)) for joint, path in zip(skeleton.names, skeleton.joints, strict=True)
    ]
    _check(where, "joints", skeleton.names, joint_names)
    network = parts.slider_network
    if network is not None:
        _check(where, "shapes", network.shapes, _all(network.shapes, names))
    return replace(
        parts,
        meshes=tuple(meshes),
        skeleton=skeleton.called(joint_names),
        animations=tuple(_animation_renamed(one, names, where) for one in parts.animations),
        sliders=tuple(_slider_renamed(one, names, where) for one in parts.sliders),
        slider_network=network and replace(network, shapes=_all(network.shapes, names)),
        vrm=_of_binds(parts.vrm, names),
    )


def _animation_renamed(animation: Animation, names: Mapping[str, str], where: object) -> Animation:
    """:raises InputError: weights that would be of one shape, and differ"""
    shapes, weights = _all(animation.shapes, names), animation.shape_weights
    first = {shape: shapes.index(shape) for shape in shapes}
    if weights is None or len(first) == len(shapes):
        return replace(animation, shapes=shapes)
    for column, shape in enumerate(shapes):
        if (weights[:, column] != weights[:, first[shape]]).any():
            one, other = animation.shapes[first[shape]], animation.shapes[column]
            raise _moved_apart(where, f"clip '{animation.name}'", one, other, shape)
    return replace(animation, shapes=tuple(first), shape_weights=weights[:, [*first.values()]])


def _slider_renamed(slider: Slider, names: Mapping[str, str], where: object) -> Slider:
    """:raises InputError: gains that would be of one shape, and differ"""
    gains: dict[str, tuple[str, float]] = {}  # new name -> old one, gain
    for shape, gain in slider.shapes:
        name = names.get(shape, shape)
        if gains.setdefault(name, (shape, gain))[1] != gain:
            raise _moved_apart(where, f"slider '{slider.name}'", gains[name][0], shape, name)
    return replace(slider, shapes=tuple((name, gain) for name, (_, gain) in gains.items()))


def _moved_apart(where: object, by: str, one: str, other: str, name: str) -> InputError:
    what = f"the shapes '{one}' and '{other}' would both be called '{name}', but the {by} moves them differently"
    return InputError(where, f"{what}, expected two names")


def _of_binds(vrm: Any, names: Mapping[str, str]) -> Any:
    """What VRM says of an avatar, its expressions bound to shapes of the new names."""
    if isinstance(vrm, Mapping):
        return {
            key: names.get(one, one) if key == "index" and isinstance(one, str) else _of_binds(one, names)
            for key, one in vrm.items()
        }
    return [_of_binds(one, names) for one in vrm] if isinstance(vrm, list) else vrm


def _check(where: object, kind: str, old: Sequence[str], new: Sequence[str]) -> None:
    """:raises InputError: a new name that another one has as well"""
    count = Counter(new)
    for name, other in zip(old, new, strict=True):
        if name != other and count[other] > 1:
            both = [before for before, called in zip(old, new, strict=True) if called == other]
            raise InputError(
                where, f"the {kind} '{both[0]}' and '{both[1]}' would both be called '{other}', expected two names"
            )


def _all(shapes: Sequence[str], names: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(names.get(shape, shape) for shape in shapes)


def convention_of(shapes: Sequence[str], meshes: Sequence[Sequence[str]] = ()) -> dict[str, Any] | None:
    """The convention that a face's shapes are called as, as JSON values; None where they are called as in none.

    Others that it follows besides are in `also`, which is not there for one alone.
    """
    matches = [
        {
            "convention": kind,
            "title": CONVENTIONS[kind].title,
            "names": count,
            "of": len(written := {*CONVENTIONS[kind].written.values()}),
            "exact": len(written.intersection(shapes)) == count,
        }
        for kind, count in _all_recognised(shapes, meshes)
    ]
    if not matches:
        return None
    first, *others = matches
    first["arkit"] = len(convention_names("arkit", shapes, meshes))
    return first | ({"also": others} if others else {})


def convention_text(match: Mapping[str, Any] | None) -> str:
    """The conventions for people, with what gives the names of the first where the face spells them otherwise."""
    if match is None:
        return "of no known convention"
    every = [match, *match.get("also", ())]
    text = f"{match['title']}, {match['names']} of {match['of']}"
    if len(every) > 1:
        text = " and ".join(f"{one['title']} {one['names']} of {one['of']}" for one in every)
    if not match["exact"]:
        return f"{text} in another spelling (--rename {match['convention']} gives its own)"
    return f"{text} (--rename arkit gives {match['arkit']} of them ARKit's names)" if match["arkit"] else text
