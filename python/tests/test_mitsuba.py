"""The material in Mitsuba: flat slabs against what the material says, tiles, Fresnel, coat, and what scenes must have."""

import warnings

import numpy as np
import pytest

import acquire

mi = pytest.importorskip("mitsuba")
import acquire.mitsuba  # noqa: E402

try:
    acquire.mitsuba.find_llvm()
except acquire.InputError as missing:
    pytest.skip(str(missing), allow_module_level=True)

MM_PER_UV = 5.0


@pytest.fixture(autouse=True)
def fast_variant():
    acquire.mitsuba.use("llvm_ad_rgb")


@pytest.fixture(scope="module")
def slab(material, tmp_path_factory):
    """The chessboard of the other tests, as a file."""
    path = tmp_path_factory.mktemp("material") / "slab.safetensors"
    material.save(path)
    return path


def corner(material):
    """Material coordinates of uv = (0, 0): half a lit step before the first lit point, steps from the lattice's ends."""
    lit = material.lit_mm
    x = (lit[:, -1] - lit[:, 0]).mean(0) / (lit.shape[1] - 1)
    y = (lit[-1] - lit[0]).mean(0) / (lit.shape[0] - 1)
    return lit.reshape(-1, 2).mean(0) - x * lit.shape[1] / 2 - y * lit.shape[0] / 2


def mesh(name, places, uv, faces):
    made = mi.Mesh(name, len(places), len(faces), has_vertex_texcoords=uv is not None)
    values = mi.traverse(made)
    values["vertex_positions"] = np.ravel(places).astype(np.float32)
    if uv is not None:
        values["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    values["faces"] = np.ravel(faces).astype(np.uint32)
    values.update()
    return made


def plate(path, material, margin=4.0):
    """A flat slab in the plane z = 0 whose x and y are the material's, mm, larger than the lit area by a margin."""
    x0, x1, y0, y1 = material.lit_extent_mm
    places = np.array([[x0 - margin, y0 - margin], [x1 + margin, y0 - margin], [x1 + margin, y1 + margin], [x0 - margin, y1 + margin]])
    uv = (places - corner(material)) / MM_PER_UV
    mesh("plate", np.pad(places, ((0, 0), (0, 1))), uv, [[0, 1, 2], [0, 2, 3]]).write_ply(str(path))
    return str(path)


def looking_at(place, width, pixels=2):
    """A camera above a place, along the normal."""
    above = mi.ScalarTransform4f().look_at([*place, 5], [*place, 0], [0, 1, 0]) @ mi.ScalarTransform4f().scale([width / 2, width / 2, 1])
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}}
    return {"type": "orthographic", "to_world": above, "film": film}


def scene(shape, file, sensor, lights, **slab):
    of_slab = {"type": "acquire_slab", "filename": str(file), "mm_per_uv": MM_PER_UV, "coat": False, "wrap": "none"} | slab
    return {
        "type": "scene",
        "integrator": {"type": "acquire_path"},
        "sensor": sensor,
        "slab": {"type": "ply", "filename": shape, "bsdf": of_slab},
    } | {f"light{k}": light for k, light in enumerate(lights)}


def mean_radiance(loaded, spp=4096, runs=8):
    """Mean of all pixels over independent runs and its standard error, each (3,)."""
    each = np.array([np.array(mi.render(loaded, spp=spp, seed=k)).mean((0, 1)) for k in range(runs)])
    return each.mean(0), each.std(0, ddof=1) / np.sqrt(runs)


def agrees(found, error, expected, share=0.0):
    """Five standard errors of eight runs, and a share that the test states."""
    assert (np.abs(found - expected) < 5 * error + share * np.abs(expected) + 1e-7).all(), (found, error, expected)


EVEN = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 1.0}}


def exitance(material, x_o, irradiance, step=0.05):
    """∫ R(x_i, x_o) E(x_i) dA by the middles of small squares of the window around x_o."""
    w, h = (n * material.info["pitch_mm"] for n in material.info["window"])
    x, y = (np.arange(-round(n / 2 / step), round(n / 2 / step)) * step + step / 2 for n in (w, h))
    x_i = x_o + np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return (material.response(x_i, x_o) * irradiance(x_i)[:, None]).sum(0) * step**2


@pytest.mark.parametrize("light", ["even", "spot"])
def test_a_flat_slab_looks_as_the_material_says(material, slab, tmp_path, light):
    x0, x1, y0, y1 = material.lit_extent_mm
    lamp, height, angle = np.array([x0 + 0.6 * (x1 - x0), y0 + 0.4 * (y1 - y0)]), 40.0, 2.0
    if light == "even":
        lights, irradiance = [EVEN], lambda x: np.ones(len(x))
    else:
        to_world = mi.ScalarTransform4f().look_at([*lamp, height], [*lamp, 0], [0, 1, 0])
        lights = [{"type": "spot", "to_world": to_world, "intensity": {"type": "rgb", "value": 1000.0}, "cutoff_angle": angle, "beam_width": 0.6 * angle}]

        def irradiance(x):
            r2 = ((x - lamp) ** 2).sum(-1)
            cosine = height / np.sqrt(height**2 + r2)
            off = np.degrees(np.arccos(cosine))
            t = (1 - (1 - np.interp(off, [0.6 * angle, angle], [0, 1]))).clip(0, 1)
            n = 1.5  # the spot reaches the slab at up to 2°, where Fresnel differs from that along the normal by less than 1e-6
            return 1000 * (1 - t) * cosine**3 / height**2 * (off < angle) * (n > 0)

    shape = plate(tmp_path / "plate.ply", material)
    for at in ([0.3, 0.35], [0.52, 0.5], [0.9, 0.1]):
        x_o = np.array([x0 + at[0] * (x1 - x0), y0 + at[1] * (y1 - y0)])
        loaded = mi.load_dict(scene(shape, slab, looking_at(x_o, 0.02), lights))
        found, error = mean_radiance(loaded)
        # 5e-3: squares of 0.05 mm cut the rim of window and lit area; the camera sees 0.02 mm.
        agrees(found, error, exitance(material, x_o, irradiance) / np.pi, 5e-3)
        assert (error < 0.02 * found).all()
