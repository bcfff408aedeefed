"""Which objects a command is asked for, and what a user's own meshes weigh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mjx_grasp.errors import InputError
from mjx_grasp.objects.catalogue import find_objects
from mjx_grasp.records.settings import CommandSettings, Positive, Settings

DENSITY = 500.0
"""kg/m³, about the median of the catalogue's objects."""


@dataclass(frozen=True)
class Weight(Settings):
    """What a mesh weighs that is not of the catalogue."""

    mass: Positive | None = None
    """of each mesh [kg]"""
    density: Positive | None = None
    """of the enclosed volume; `DENSITY` if neither is given [kg/m³]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mass is not None and self.density is not None:
            both = (self.mass, self.density)
            raise InputError("--mass and --density", both, "one of them at most")

    def of(self, volume: float) -> tuple[float, str]:
        """The mass [kg] of a volume [m³], and in words where it comes from."""
        if self.mass is not None:
            return self.mass, "as asked for"
        if self.density is not None:
            return self.density * volume, f"at {self.density:g} kg/m³"
        assumed = f"assuming {DENSITY:g} kg/m³; --mass or --density says otherwise"
        return DENSITY * volume, assumed


@dataclass(frozen=True, kw_only=True)
class ObjectsConfig(CommandSettings):
    """What every command on objects is asked for."""

    objects: tuple[str, ...] = ("eight",)
    """objects or groups (eight, train, held_out, all) of the catalogue, or meshes and folders of
    meshes of your own (.obj, .ply, .stl, .glb, .off; metres)"""
    objects_dir: Path | None = None
    """folder of real scans of the catalogue's objects; parametric stand-ins without one"""
    mass: Positive | None = None
    """of each mesh of your own [kg]"""
    density: Positive | None = None
    """of meshes of your own, instead of a mass; 500 if neither is given [kg/m^3]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        Weight(self.mass, self.density)  # refuses both

    @property
    def weight(self) -> Weight:
        """What meshes of the user weigh."""
        return Weight(self.mass, self.density)

    @property
    def scans(self) -> bool | None:
        """Whether all objects are scans, or stand-ins; None with meshes of the user among them."""
        own = any(each.file is not None for each in find_objects(self.objects))
        return None if own else self.objects_dir is not None
