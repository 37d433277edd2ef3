"""Counts on a composed stage, checked before USD follows it: it recurses, or takes the square or more of them."""

from __future__ import annotations

from pxr import Sdf, Usd, UsdSkel

from facepipe.core.errors import InputError
from facepipe.stage.guard import UNREADABLE
from facepipe.stage.layer_files import MOST_LEVELS

MOST_SCHEMAS = 1250  # on a prim, and the root of the squares of all lists of them: USD takes up to 3 us for each square
MOST_STEPS = 1000  # properties that lead on, from one to all that it leads to, each as often as USD comes there
_FEW_SCHEMAS = 10
_EVERYTHING = Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)


def check_counts(where: object, stage: Usd.Stage) -> None:
    """Look through a stage without composing what its prims are.

    :raises InputError: too many API schemas, joints too deep, or properties that lead through too many others or back
        to themselves
    """
    root = stage.GetPseudoRoot()
    _check_schemas(where, root)
    steps: dict[Sdf.Path, int] = {}
    for path in root.FindAllAttributeConnectionPaths(_EVERYTHING):
        if path.IsPropertyPath():
            _check_steps(where, stage, path, steps)
    for prim in Usd.PrimRange(root, _EVERYTHING):
        if prim.IsA(UsdSkel.Skeleton):
            _check_joints(where, prim)
        for relationship in prim.GetAuthoredRelationships():
            _check_steps(where, stage, relationship.GetPath(), steps)


def _check_schemas(where: object, root: Usd.Prim) -> None:
    lists: set[tuple[str, ...]] = set()
    squares = 0
    for prim in Usd.PrimRange(root, _EVERYTHING):
        applied = tuple(prim.GetPrimTypeInfo().GetAppliedAPISchemas())
        if len(applied) > _FEW_SCHEMAS and applied not in lists:
            lists.add(applied)
            squares += len(applied) ** 2
            if squares > MOST_SCHEMAS**2:
                found = f"{len(applied)} API schemas here and {sum(map(len, lists)) - len(applied)} on other prims"
                raise InputError(f"{where} -> {prim.GetPath()}", f"{found}, expected at most {MOST_SCHEMAS}")


def _check_joints(where: object, prim: Usd.Prim) -> None:
    try:
        joints = UsdSkel.Skeleton(prim).GetJointsAttr().Get() or ()
        deepest = max((str(joint).count("/") for joint in joints), default=0)
    except UNREADABLE:
        return  # its reader reports that
    if deepest >= MOST_LEVELS:
        raise InputError(f"{where} -> {prim.GetPath()}.joints", f"nests joints more than {MOST_LEVELS} deep")


def _check_steps(where: object, stage: Usd.Stage, start: Sdf.Path, steps: dict[Sdf.Path, int]) -> None:
    """Follow a property as USD does, which goes several ways to one and the same several times.

    :param steps: of the properties that were followed; filled in
    """
    # a list instead of recursion, which a long chain of connections would end at Python's limit
    todo, begun = [start], set()
    while todo:
        path = todo[-1]
        if path in steps:
            todo.pop()
        elif path not in begun:
            begun.add(path)
            onward = _onward(stage, path)
            if any(following in begun and following not in steps for following in onward):
                raise InputError(f"{where} -> {path}", "leads back to itself, expected an end")
            todo.extend(onward)
        else:
            onward = _onward(stage, path)
            steps[path] = 1 + sum(steps[following] for following in onward) if onward else 0
            if steps[path] > MOST_STEPS:
                raise InputError(f"{where} -> {path}", f"leads through more than {MOST_STEPS} properties")


def _onward(stage: Usd.Stage, path: Sdf.Path) -> list[Sdf.Path]:
    found = stage.GetPropertyAtPath(path)
    paths = found.GetConnections() if isinstance(found, Usd.Attribute) else found.GetTargets() if found else []
    return [target for target in paths if target.IsPropertyPath()]
