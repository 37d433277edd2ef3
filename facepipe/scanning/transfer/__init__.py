"""Transfer: a template's shapes onto the mesh of another head."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.scanning.transfer.carry import Carried, Carrier, carried
    from facepipe.scanning.transfer.fit import HeadFit, fit_head
    from facepipe.scanning.transfer.mesh import HeadMesh
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Carried", "Carrier", "HeadFit", "HeadMesh", "carried", "fit_head"]
