"""Transfer: a template's shapes onto the mesh of another head."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.scanning.transfer.carry import Carried, Carrier, carried
    from facepipe.scanning.transfer.fit import HeadFit, HeadMesh, fit_head
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Carried", "Carrier", "HeadFit", "HeadMesh", "carried", "fit_head"]
