"""What a shape is made of: a factored material under a rough dielectric coat, as a BSDF plug-in of Mitsuba."""

from __future__ import annotations

import os

import drjit as dr
import mitsuba as mi

from .. import InputError, Material, Matrix
from ._factors import WRAPS, Factors, Table


def transmittance(cosine: mi.Float, eta: float) -> mi.Float:
    """What Fresnel lets through a face at this cosine, relative to normal incidence.

    R̂_d was measured under light along the normal and holds that loss; so does the camera's side.
    """
    if eta == 1:
        return dr.select(cosine > 0, mi.Float(1), 0)
    return (1 - mi.fresnel(cosine, eta)[0]) / (1 - ((eta - 1) / (eta + 1)) ** 2)


def _number(props: mi.Properties, name: str, default: float, low: float, high: float, open_low: bool = False) -> float:
    value = float(props.get(name, default))
    if not (low < value if open_low else low <= value) or not value <= high:
        raise InputError(f"bsdf acquire_slab: {name}: expected a number from {'above ' if open_low else ''}{low} to {high}, found {value}", "Setting")
    return value


def make_slab(base: type) -> type:
    """The class for the current variant, whose ``mi.BSDF`` is ``base``."""

    class Slab(base):
        """BSDF ``acquire_slab``; its parameters are in ``docs/rendering.md``. By itself it is the coat: what is under it needs the integrator ``acquire_path``."""

        def __init__(self, props: mi.Properties) -> None:
            base.__init__(self, props)
            for name in ("filename", "mm_per_uv"):
                if name not in props:
                    raise InputError(f"bsdf acquire_slab: {name} is missing: the material's file, and how many mm of it one unit of UV has", "Setting")
            #: Shown in errors.
            self.filename = str(props["filename"])
            self.mm_per_uv = _number(props, "mm_per_uv", 0, 0, 1e9, open_low=True)
            self.eta = _number(props, "int_ior", 1.5, 1, 5)
            wrap, alpha = str(props.get("wrap", "repeat")), _number(props, "alpha", 0.1, 0, 1)
            self.exit_fresnel, coat = bool(props.get("exit_fresnel", True)), bool(props.get("coat", True))
            if wrap not in WRAPS:
                raise InputError(f"bsdf acquire_slab: wrap: expected one of {', '.join(WRAPS)}, found {wrap}", "Setting")
            path = str(mi.file_resolver().resolve(self.filename))
            self.source = Matrix.open(path) if os.path.isdir(path) else Material.load(path)
            self.factors = (Table if os.path.isdir(path) else Factors)(self.source, wrap)
            self.coat = mi.load_dict(self._coat(coat and self.eta > 1, alpha))
            self.m_components = [self.coat.flags(i) for i in range(self.coat.component_count())]
            self.m_flags = self.coat.flags()

        def _coat(self, there: bool, alpha: float) -> dict:
            if not there:
                return {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
            plastic = {"type": "plastic"} if alpha == 0 else {"type": "roughplastic", "distribution": "ggx", "alpha": alpha}
            return plastic | {"int_ior": self.eta, "ext_ior": 1.0, "diffuse_reflectance": {"type": "rgb", "value": 0.0}}

        def sample(self, ctx, si, sample1, sample2, active=True):
            return self.coat.sample(ctx, si, sample1, sample2, active)

        def eval(self, ctx, si, wo, active=True):
            return self.coat.eval(ctx, si, wo, active)

        def pdf(self, ctx, si, wo, active=True):
            return self.coat.pdf(ctx, si, wo, active)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.coat.eval_pdf(ctx, si, wo, active)

        def enters(self, cosine):
            """Entry's transmittance over that along the normal."""
            return transmittance(cosine, self.eta)

        def leaves(self, cosine):
            """Exit's transmittance over that along the normal."""
            return transmittance(cosine, self.eta if self.exit_fresnel else 1.0)

        def place_mm(self, uv):
            """Material coordinates of a place on the shape: row 0 of a map is at v = 0, as in Mitsuba's bitmaps."""
            (x, _), (y, _) = self.factors.tile_mm
            return mi.Point2f(x + self.mm_per_uv * uv.x, y + self.mm_per_uv * uv.y)

        def draw(self, exit_mm, choice, jitter, lit, active):
            """A place where light enters, for one where it leaves.

            :returns: d = x_o − x_i on the shape's chart, mm, and R̂_d · area / probability for it, no unit.
            """
            x, y, offset, area = self.factors.draw_offset(choice, jitter)
            index, place, mirrored, inside = self.factors.draw_lit_point(exit_mm - offset, lit)
            signs = [dr.select(flip, -1, 1) for flip in mirrored]
            width, height = self.factors.window
            x, y = (s * (k - n // 2) + n // 2 for s, k, n in zip(signs, (x, y), (width, height)))
            leaves_mm = mi.Point2f(place.x + signs[0] * offset.x, place.y + signs[1] * offset.y)
            return offset, self.factors.response(index, x, y, leaves_mm, active & inside) * area

        def to_string(self):
            return f"acquire_slab[\n  filename = {self.filename},\n  mm_per_uv = {self.mm_per_uv:g},\n  wrap = {self.factors.wrap},\n  int_ior = {self.eta:g}\n]"

    return Slab
