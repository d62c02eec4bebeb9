"""The statue on its floor under some lights."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

import acquire.mitsuba

from ._statue import HEIGHT_MM, statue

_T = mi.ScalarTransform4f


class Stage:
    """A camera before the statue; pictures are ``width`` by 1.5 ``width``."""

    def __init__(self, path: Path, width: int, spp: int) -> None:
        self.path, self.width, self.spp = path, width, spp
        self.mm_per_uv = statue(path)

    def render(self, file: Path, light: str, *, near: bool = False, seed: int = 0, spp: int | None = None) -> np.ndarray:
        """A linear picture, (1.5 width, width, 3), of the statue made of a material or matrix.

        :param spp: paths for a pixel; default: the stage's.
        """
        return self.picture(self.scene(file, light, near=near), seed=seed, spp=spp)

    def picture(self, scene: mi.Scene, *, seed: int = 0, spp: int | None = None) -> np.ndarray:
        """A linear picture of a scene of this stage."""
        return np.array(acquire.mitsuba.render(scene, spp=spp or self.spp, seed=seed))

    def scene(self, file: Path, light: str, *, near: bool = False) -> mi.Scene:
        """The statue made of a material or matrix, on its floor under a light."""
        slab = {"type": "acquire_slab", "filename": str(file), "mm_per_uv": self.mm_per_uv, "wrap": "mirror"}
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "acquire_path", "max_depth": 6},
                "sensor": self._sensor(near),
                "statue": {"type": "ply", "filename": str(self.path), "bsdf": slab},
                "floor": {
                    "type": "rectangle",
                    "to_world": _T().scale(5 * HEIGHT_MM),
                    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.15}},
                },
            }
            | _LIGHTS[light]
        )

    def _sensor(self, near: bool) -> dict:
        eye, aim, fov = ([90, -22, 78], [0, 0, 62], 26) if near else ([170, -40, 70], [0, 0, 38], 22)
        film = {"type": "hdrfilm", "width": self.width, "height": self.width * 3 // 2, "rfilter": {"type": "gaussian"}}
        return {"type": "perspective", "fov": fov, "to_world": _T().look_at(eye, aim, [0, 0, 1]), "film": film}


def _rgb(value: float) -> dict:
    return {"type": "rgb", "value": value}


def _panel(eye: list[float], side: float, radiance: float) -> dict:
    to_world = _T().look_at(eye, [0, 0, 40], [0, 0, 1]) @ _T().scale(side)
    return {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": _rgb(radiance)}, "bsdf": {"type": "diffuse"}}


_SKY = {"type": "constant", "radiance": _rgb(0.03)}
_SPOT = {"type": "spot", "to_world": _T().look_at([120, 60, 180], [0, 0, 45], [0, 0, 1]), "intensity": _rgb(1.2e5), "cutoff_angle": 14}
_LIGHTS = {
    "spot": {"sky": _SKY, "spot": _SPOT},
    "window": {"sky": _SKY, "panel": _panel([150, 150, 130], 50, 9.0)},
    "behind": {"sky": _SKY, "panel": _panel([-60, 160, 130], 50, 22.0)},
}
