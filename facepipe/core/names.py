"""Names as USD identifiers, names chosen by globs, and the names that a wrong one may have meant."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase
from pathlib import PurePosixPath

from facepipe.core.errors import InputError

_LONGEST = 200  # characters of an identifier, bytes of a file's name without its suffix
_LONGEST_SUFFIX = 12
_DEVICE = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[\d¹²³])\s*(\..*)?", re.IGNORECASE)  # of Windows
_FEW = 6  # right names in a message
_SHOWN = 60  # characters of a wrong name in a message
_LONGEST_LIKE = 200  # characters of a wrong name that are compared
_SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"))  # anywhere in a name
_LETTERS = re.compile(r"(?<![A-Za-z0-9])([lLrR])(?![A-Za-z0-9])|(?<=[_.\-])([lLrR])(?=\d)")  # as words of their own
_OPPOSITE = str.maketrans("lLrR", "rRlL")


def identifier(text: str, fallback: str = "unnamed") -> str:
    """`text` as a USD identifier: letters of any script, digits and underscores, no digit first, 200 at most.

    >>> identifier("breast.L"), identifier("2nd tooth"), identifier("あ"), identifier("")
    ('breast_L', '_2nd_tooth', 'あ', 'unnamed')
    """
    safe = "".join(one if f"a{one}".isidentifier() else "_" for one in text.strip()[:_LONGEST])
    if not safe:
        return fallback
    return safe if safe.isidentifier() else f"_{safe}"


def check_identifier(where: str, name: str) -> None:
    """:raises InputError: `name` is no USD identifier"""
    if identifier(name) != name:
        raise InputError(f"{where} {name}", f"no name of a prim, expected one like {identifier(name)}")


def file_name(text: str, fallback: str = "unnamed") -> str:
    """`text`, a name or path that a file brought along, as a name that files have on any system, in one folder.

    >>> file_name("textures/skin 1.png"), file_name("C:\\\\x\\\\a:b.png"), file_name("con.png"), file_name("..")
    ('skin 1.png', 'a_b.png', '_con.png', 'unnamed')
    """
    name = re.split(r"[/\\]", text)[-1]
    plain = "".join("_" if one in '<>:"|?*' or not one.isprintable() else one for one in name).strip(" .")
    path = PurePosixPath(plain)
    stem = path.stem.encode()[:_LONGEST].decode(errors="ignore") or fallback
    return f"{'_' if _DEVICE.fullmatch(stem) else ''}{stem}{path.suffix[:_LONGEST_SUFFIX]}".rstrip(" .")


def unique_identifiers(names: Iterable[str], fallback: str = "unnamed") -> tuple[str, ...]:
    """Identifiers for `names`, in order; a name already taken gets the next free ``_2``, ``_3`` ..."""
    return numbered(identifier(name, fallback) for name in names)


def numbered(names: Iterable[str], taken: Iterable[str] = ()) -> tuple[str, ...]:
    """The names, in order; one that is already taken gets the next free ``_2``, ``_3`` ..."""
    used, result, following = {*taken}, [], dict[str, int]()
    for name in names:
        candidate, number = name, following.get(name, 2)  # from 2 on each time, a name of 100,000 things took minutes
        while candidate in used:
            candidate, number = f"{name}_{number}", number + 1
        following[name] = number
        used.add(candidate)
        result.append(candidate)
    return tuple(result)


def handles(names: Sequence[str], fallback: str) -> tuple[str, ...]:
    """What to call things whose names are any text: their own where one alone has it, else a free identifier.

    >>> handles(["Key 1", "Key", "Key", ""], "shape")
    ('Key 1', 'Key', 'Key_2', 'shape')
    """
    count = Counter(names)
    own = [name for name in names if name and count[name] == 1]
    others = [name for name in names if not name or count[name] > 1]
    free = iter(unique_identifiers([*own, *others], fallback)[len(own) :])
    return tuple(name if name and count[name] == 1 else next(free) for name in names)


def first_names(names: Sequence[str], most: int) -> str:
    """Names with commas between, of more than `most` the first ones and dots."""
    return ", ".join(names[:most]) + (" ..." if len(names) > most else "")


def fits_joint(pattern: str, joint: str) -> bool:
    """Whether a glob, or the source's name of a joint, stands for a joint path: for all of it or for its last part.

    >>> fits_joint("ja*", "head/jaw"), fits_joint("eye.L", "head/eye_L"), fits_joint("head", "head/jaw")
    (True, True, False)
    """
    leaf = joint.rpartition("/")[2]
    return fnmatchcase(joint, pattern) or fnmatchcase(leaf, pattern) or leaf == identifier(pattern)


def select(names: Sequence[str], globs: str, option: str) -> tuple[str, ...]:
    """The `names` that one of the comma-separated `globs` matches, in their order; none where there is no glob.

    >>> select(("jawOpen", "browUp", "jawLeft"), "jaw*", "shapes")
    ('jawOpen', 'jawLeft')

    :param option: what the globs were given as, for messages
    :raises InputError: a glob other than ``*`` that matches none
    """
    patterns = [glob.strip() for glob in globs.split(",") if glob.strip()]
    for pattern in patterns:
        if pattern != "*" and not any(name == pattern or fnmatchcase(name, pattern) for name in names):
            some = first_names(names, 4) or "none, there are none"
            near = did_you_mean(pattern, names) or f", expected some of: {some}"
            raise InputError(f"option {option}", f"'{pattern[:_SHOWN]}' matches none of {len(names)}{near}")
    return tuple(name for name in names if any(name == one or fnmatchcase(name, one) for one in patterns))


def did_you_mean(name: str, known: Collection[str]) -> str:
    """The end of a message about a name that is not there: the known one that is most like it, or nothing.

    >>> did_you_mean("jawopn", ["jawOpen", "jawLeft"]), did_you_mean("tail", ["jawOpen"])
    (", did you mean 'jawOpen'?", '')
    """
    folded = {one.casefold(): one for one in reversed(list(known))}
    near = get_close_matches(name[:_LONGEST_LIKE].casefold(), folded, n=1)
    return f", did you mean '{folded[near[0]]}'?" if near else ""


def unknown(name: str, known: Collection[str], kind: str) -> str:
    """A message about a name that is not there, with the nearest that is, or a few of those.

    >>> unknown("jawopn", ["jawOpen", "jawLeft"], "shape"), unknown("tail", ["jawOpen"], "shape")
    ("no shape 'jawopn', did you mean 'jawOpen'?", "no shape 'tail', expected one of jawOpen")
    """
    return f"no {kind} '{name[:_SHOWN]}'{suggestion(name, known)}"


def suggestion(name: str, known: Collection[str], otherwise: str = "") -> str:
    """The end of a message about a name that is not there: the nearest that is, else a few, or `otherwise`."""
    some = first_names(list(known), _FEW) or otherwise
    return did_you_mean(name, known) or (f", expected one of {some}" if some else "; there are none")


def check_keys(where: object, keys: Iterable[str], known: Collection[str]) -> None:
    """:raises InputError: a key that is not known, with the nearest that is, or all of these"""
    for key in keys:
        if key not in known:
            near = did_you_mean(key, known) or f", expected some of {', '.join(known)}"
            raise InputError(where, f"'{key[:40]}' is unknown{near}")


def unmatched(pattern: str, known: Sequence[str], what: str) -> str:
    """A message about a pattern that fits nothing, with the nearest name that is there, or a few of those."""
    some = f"some of {', '.join(known[:4])} ..." if known else "a face that has some"
    return f"matches none of {len(known)} {what}{did_you_mean(pattern, known) or f', expected {some}'}"


def find(name: str, known: Collection[str], where: object, kind: str) -> str:
    """The known name that is `name`, or alone differs from it in case.

    :param where: what the name was given as; `kind`: what it should name; both for messages
    :raises InputError: no such name, or only ones that differ in case alone
    """
    if name in known:
        return name
    alike = [one for one in known if one.casefold() == name.casefold()]
    if len(alike) == 1:
        return alike[0]
    if alike:
        raise InputError(where, f"no {kind} '{name}', but {len(alike)} that differ in case, like '{alike[0]}'")
    raise InputError(where, unknown(name, known, kind))


def find_joint(name: str, joints: Sequence[str], names: Sequence[str], where: object) -> int:
    """The number of the joint that is called `name`: by its path, else its source's name, else its path's last part,
    else any of these in another case.

    :param joints: paths
    :param names: the source's name of each
    :raises InputError: no such joint, or several
    """
    spellings = [list(joints), list(names), [joint.rpartition("/")[2] for joint in joints]]
    spellings += [[one.casefold() for one in spelling] for spelling in spellings]
    for number, spelling in enumerate(spellings):
        places = [i for i, one in enumerate(spelling) if one == (name if number < 3 else name.casefold())]
        if len(places) == 1:
            return places[0]
        if places:
            paths = ", ".join(joints[i] for i in places[:3])
            raise InputError(where, f"{len(places)} joints called '{name}', expected a path: {paths}")
    raise InputError(where, unknown(name, list(dict.fromkeys([*names, *spellings[2]])), "joint"))


def mirrored_name(name: str) -> str:
    """The name on the other side; the same for one in the middle.

    >>> [mirrored_name(name) for name in ("eye_L", "browInnerLeft", "r_lip.02", "jaw")]
    ['eye_R', 'browInnerRight', 'l_lip.02', 'jaw']
    """
    return next(iter(mirrored_names(name)), name)


def mirrored_names(name: str) -> list[str]:
    """What the name on the other side may be, likelier ones first: ``upright_L`` has a side, but not two."""
    names = []
    for one, other in _SIDES:
        if one in name or other in name:
            names.append(other.join(part.replace(other, one) for part in name.split(one)))
    names.append(_LETTERS.sub(lambda letter: letter[0].translate(_OPPOSITE), name))
    return [other for other in names if other != name]


def named(values: Mapping[str, float], known: Collection[str], flag: str, kind: str) -> dict[str, float]:
    """Values by the names in `known`; the given names may differ from these in case alone, if one fits.

    :raises InputError: no such name, or one twice
    """
    by_name: dict[str, float] = {}
    for given, value in values.items():
        name = find(given, known, f"{flag} {given}", kind)
        if name in by_name:
            raise InputError(f"{flag} {given}", f"means {kind} '{name}' once more, expected it once")
        by_name[name] = value
    return by_name
