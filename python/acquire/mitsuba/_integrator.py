"""A path tracer that knows what leaves a slab elsewhere than it entered, as an integrator plug-in of Mitsuba."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .. import InputError
from ._checks import slabs_of

#: How far a probe starts from the tangent plane, as a share of the offset's length.
_LIFT = 1e-3
#: Least and most probability that a path goes on by the coat's reflection, not under it.
_LEAST_COAT, _MOST_COAT = 0.1, 0.9


def _balance(pdf: mi.Float, other: mi.Float) -> mi.Float:
    """Weight of multiple importance sampling, power heuristic."""
    a, b = pdf * pdf, other * other
    return a / dr.maximum(a + b, 1e-30)  # both 0 where nothing is: a scalar variant must not divide by that


def _pick(condition, yes, no):
    """``dr.select`` for whole interactions, which a scalar variant has not."""
    return dr.select(condition, yes, no) if dr.is_jit_v(mi.Float) else (yes if condition else no)


def entry_point(scene, slab, si, step, active):
    """Where on the same material a step (world units) along the tangent plane of ``si`` ends.

    From the end P of the step two probes go at 45° to the point below and to that above ``si`` at the step's length: over an edge of a cube or into its
    corner the step keeps its length, a plane it meets at P. The nearer face wins that is seen from outside.
    """
    length = dr.norm(step)
    end = si.p + step
    found, best, nearest = active & False, dr.zeros(mi.SurfaceInteraction3f), mi.Float(dr.inf)
    for side in (-1, 1):
        start = end - side * _LIFT * length * si.n
        way = si.p + side * length * si.n - start
        t = dr.norm(way)
        ray = mi.Ray3f(start, way / t)
        ray.maxt = t
        hit = scene.ray_intersect(ray, mi.RayFlags.All, False, active & (length > 0))
        if not dr.is_jit_v(mi.Float) and not hit.is_valid():
            continue
        right = hit.is_valid() & (hit.bsdf() == slab) & (side * dr.dot(hit.n, ray.d) > 0) & (hit.t < nearest)
        best, nearest, found = _pick(right, hit, best), dr.select(right, hit.t, nearest), found | right
    return best, found


def make_integrator(base: type) -> type:
    """The class for the current variant, whose ``mi.SamplingIntegrator`` is ``base``."""

    class Integrator(base):
        """Integrator ``acquire_path``; its parameters are in ``docs/rendering.md``."""

        def __init__(self, props: mi.Properties) -> None:
            base.__init__(self, props)
            self.max_depth, self.rr_depth = int(props.get("max_depth", 8)), int(props.get("rr_depth", 5))
            self.candidates = int(props.get("candidates", 1))
            for name, low in (("max_depth", -1), ("rr_depth", 1), ("candidates", 1)):
                if getattr(self, name) < low:
                    raise InputError(f"integrator acquire_path: {name}: expected a whole number from {low}, found {getattr(self, name)}", "Setting")
            self.hides = bool(props.get("hide_emitters", False))
            self.depth_limit = 2**31 - 1 if self.max_depth < 0 else self.max_depth
            self.slabs: list | None = None

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            self.slabs = slabs_of(scene, sensor)
            return base.render(self, scene, sensor, seed, spp, develop, evaluate)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            if self.slabs is None:
                self.slabs = slabs_of(scene)
            return *self.trace(scene, sampler, mi.Ray3f(ray), mi.Spectrum(1), dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True), 0, active), []

        def irradiance_at(self, scene, sampler, slab, si, active=True):
            """An estimate of all light that enters a slab at a place: irradiance over π, each direction by its Fresnel."""
            if self.slabs is None:
                self.slabs = slabs_of(scene)
            wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(active))
            ray, weight = si.spawn_ray(si.to_world(wo)), mi.Spectrum(slab.enters(wo.z))
            rest, _ = self.trace(scene, sampler, ray, weight, mi.Interaction3f(si), wo.z * dr.inv_pi, mi.Bool(False), 1, active)
            return self.irradiance(scene, sampler, slab, si, active) + rest

        def trace(self, scene, sampler, ray, weight, last, last_pdf, unlit, depth, active):
            """Radiance along a ray, and whether it hits anything at depth 0.

            :param last_pdf: density with which the ray's direction was drawn at ``last``, for light that is drawn there too unless ``unlit``.
            """
            state = (sampler, ray, mi.Spectrum(0), weight, mi.UInt32(depth), last, last_pdf, unlit, mi.Bool(False), mi.Bool(active))
            end = dr.while_loop(state, lambda *s: s[-1], lambda *s: self.bounce(scene, *s), label="acquire")
            return end[2], end[8]

        def bounce(self, scene, sampler, ray, light, weight, depth, last, last_pdf, unlit, hit, active):
            """One surface of a path: what it emits, what lights it, and where the path goes on."""
            scalar = not dr.is_jit_v(mi.Float)
            si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
            emitter = si.emitter(scene)
            if not scalar or emitter is not None:
                ds = mi.DirectionSample3f(scene, si, last)
                drawn = scene.pdf_emitter_direction(last, ds, ~unlit if not scalar else not unlit)
                seen = active & ~(mi.Bool(self.hides) & (depth == 0)) if not scalar else active and not (self.hides and depth == 0)
                balance = dr.select(unlit, 1, _balance(last_pdf, drawn))
                light = light + weight * balance * emitter.eval(si, seen)
            hit = hit | ((depth == 0) & si.is_valid())
            active = active & si.is_valid() & (depth + 1 < self.depth_limit)
            if scalar and not active:
                return sampler, ray, light, weight, depth, last, last_pdf, unlit, hit, False

            bsdf, ctx = si.bsdf(ray), mi.BSDFContext()
            light = light + weight * self.lit(scene, sampler, si, bsdf, ctx, active)
            drawn, value = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
            on, after = si.spawn_ray(si.to_world(drawn.wo)), weight * value
            pdf, unlit = drawn.pdf, mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
            last = mi.Interaction3f(si)
            for slab in self.slabs:
                inside = active & (bsdf == slab) & (mi.Frame3f.cos_theta(si.wi) > 0)
                if scalar and not inside:
                    continue
                reflects = dr.clip(mi.fresnel(mi.Frame3f.cos_theta(si.wi), slab.eta)[0], _LEAST_COAT, _MOST_COAT)
                entry, share, entered = self.enter(scene, sampler, slab, si, inside)
                light = light + weight * share * self.irradiance(scene, sampler, slab, entry, entered)
                wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(inside))
                under = sampler.next_1d(inside) >= reflects
                into = share * slab.enters(wo.z) / (1 - reflects)
                after = dr.select(inside, dr.select(under, dr.select(entered, weight * into, 0), after / reflects), after)
                goes = inside & under & entered
                on = _pick(goes, entry.spawn_ray(entry.to_world(wo)), on)
                last = _pick(goes, mi.Interaction3f(entry), last)
                pdf, unlit = dr.select(goes, wo.z * dr.inv_pi, pdf), dr.select(goes, False, unlit)
            return self.go_on(sampler, on, light, after, depth, last, pdf, unlit, hit, active)

        def go_on(self, sampler, ray, light, weight, depth, last, pdf, unlit, hit, active):
            """Russian roulette, and the state of the next round."""
            most = dr.max(abs(weight))  # a truncated series has negative responses too
            stays = dr.select(depth + 1 >= self.rr_depth, dr.minimum(most, 0.95), 1)
            survives = sampler.next_1d(active) < stays
            weight = dr.select(survives & (stays > 0), weight / dr.maximum(stays, 1e-9), 0)
            return sampler, ray, light, weight, depth + 1, last, pdf, unlit, hit, active & survives & (most > 0)

        def lit(self, scene, sampler, si, bsdf, ctx, active):
            """Radiance towards the path of what one emitter sends to a surface, by its BSDF."""
            smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            ds, arriving = scene.sample_emitter_direction(si, sampler.next_2d(active), True, smooth)
            smooth = smooth & (ds.pdf > 0)
            value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), smooth)
            balance = dr.select(ds.delta, 1, _balance(ds.pdf, pdf))
            return dr.select(smooth, value * arriving * balance, 0)

        def enter(self, scene, sampler, slab, si, active):
            """A place where light enters for one where it leaves: the interaction there, R̂_d · area / probability · exit Fresnel, and whether there is one."""
            exit_mm, cosine = slab.place_mm(si.uv), mi.Frame3f.cos_theta(si.wi)
            offset, share, sum_of = mi.Point2f(0), mi.Spectrum(0), mi.Float(0)
            for _ in range(self.candidates):
                d, value = slab.draw(exit_mm, sampler.next_1d(active), sampler.next_2d(active), sampler.next_2d(active), active)
                if self.candidates == 1:
                    offset, share = d, value
                    continue
                # One of them in proportion to its response: only that one is probed and lit.
                size = dr.mean(abs(value))
                sum_of = sum_of + size
                taken = sampler.next_1d(active) * sum_of < size
                offset, share = _pick(taken, d, offset), _pick(taken, value / dr.maximum(size, 1e-30), share)
            if self.candidates > 1:
                share = share * sum_of / self.candidates
            step = -(si.dp_du * offset.x + si.dp_dv * offset.y) / slab.mm_per_uv
            entry, found = entry_point(scene, slab, si, step, active & (dr.max(abs(share)) > 0))
            return entry, dr.select(found, share * slab.leaves(cosine), 0), found

        def irradiance(self, scene, sampler, slab, si, active):
            """One emitter's irradiance that enters, over π."""
            ds, arriving = scene.sample_emitter_direction(si, sampler.next_2d(active), True, active)
            cosine = dr.dot(si.sh_frame.n, ds.d)
            active = active & (ds.pdf > 0) & (cosine > 0) & (dr.dot(si.n, ds.d) > 0)
            balance = dr.select(ds.delta, 1, _balance(ds.pdf, cosine * dr.inv_pi))
            return dr.select(active, arriving * slab.enters(cosine) * cosine * dr.inv_pi * balance, 0)

        def to_string(self):
            return f"acquire_path[\n  max_depth = {self.max_depth},\n  rr_depth = {self.rr_depth},\n  candidates = {self.candidates}\n]"

    return Integrator
