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
    """Material coordinates of uv = (0, 0): of the largest box along the axes, of the shape of its bounds, that no lit point's cell leaves."""
    lit = material.lit_mm
    x = (lit[:, -1] - lit[:, 0]).mean(0) / (lit.shape[1] - 1) * lit.shape[1]
    y = (lit[-1] - lit[0]).mean(0) / (lit.shape[0] - 1) * lit.shape[0]
    half = (abs(x) + abs(y)) / 2
    shares = np.linspace(0.5, 1, 50_001)[:, None, None]
    corners = shares * half * [[1, 1], [1, -1]]
    inside = (abs(corners @ np.linalg.inv(np.stack([x, y]))) <= 0.5 + 1e-9).all((1, 2))
    return lit.reshape(-1, 2).mean(0) - shares[inside].max() * half


def mesh(name, places, uv, faces, normals=None):
    made = mi.Mesh(name, len(places), len(faces), has_vertex_texcoords=uv is not None, has_vertex_normals=normals is not None)
    values = mi.traverse(made)
    values["vertex_positions"] = np.ravel(places).astype(np.float32)
    if uv is not None:
        values["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    if normals is not None:
        values["vertex_normals"] = np.ravel(normals).astype(np.float32)
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
    """∫ R(x_i, x_o) E(x_i) dA over the tile, by the middles of small squares of the window around x_o."""
    w, h = (n * material.info["pitch_mm"] for n in material.info["window"])
    x, y = (np.arange(-round(n / 2 / step), round(n / 2 / step)) * step + step / 2 for n in (w, h))
    x_i = x_o + np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    low = corner(material)
    inside = ((x_i > low) & (x_i < 2 * material.lit_mm.reshape(-1, 2).mean(0) - low)).all(-1)
    return (material.response(x_i, x_o) * (irradiance(x_i) * inside)[:, None]).sum(0) * step**2


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
            # At most 2° off the normal, where Fresnel differs from that along it by less than 1e-6.
            cosine = height / np.sqrt(height**2 + ((x - lamp) ** 2).sum(-1))
            fall = np.interp(np.degrees(np.arccos(cosine)), [0.6 * angle, angle], [1, 0])
            return 1000 * fall * cosine**3 / height**2

    shape = plate(tmp_path / "plate.ply", material)
    for at in ([0.3, 0.35], [0.52, 0.5], [0.9, 0.1]):
        x_o = np.array([x0 + at[0] * (x1 - x0), y0 + at[1] * (y1 - y0)])
        loaded = mi.load_dict(scene(shape, slab, looking_at(x_o, 0.02), lights))
        found, error = mean_radiance(loaded)
        # 5e-3: squares of 0.05 mm cut the rim of window and lit area; the camera sees 0.02 mm.
        agrees(found, error, exitance(material, x_o, irradiance) / np.pi, 5e-3)
        assert (error < 0.02 * found).all()


@pytest.fixture(scope="module")
def even_slab(tmp_path_factory):
    """A homogeneous material with uneven sides, one term: its albedo is known by hand."""
    folder = tmp_path_factory.mktemp("even")
    fall = 0.02 * np.exp(-np.hypot(*np.mgrid[-3:4, -4:5])[..., None] * [0.6, 0.8, 1.1])
    acquire.write_matrix(folder / "even.rd.zarr", np.broadcast_to(fall, (9, 12, 7, 9, 3)), pitch_mm=0.5)
    material = acquire.factor(folder / "even.rd.zarr", terms=1)
    material.save(folder / "even.safetensors")
    return folder / "even.safetensors", material, fall.sum((0, 1)) * 0.5**2


def fresnel(cosine, eta=1.5):
    """Unpolarized reflectance, textbook form."""
    inside = np.sqrt(1 - (1 - cosine**2) / eta**2)
    across = (cosine - eta * inside) / (cosine + eta * inside)
    along = (eta * cosine - inside) / (eta * cosine + inside)
    return (across**2 + along**2) / 2


def relative(cosine):
    return (1 - fresnel(cosine)) / (1 - fresnel(1.0))


def test_light_enters_and_leaves_by_fresnel(even_slab, tmp_path):
    file, material, albedo = even_slab
    shape = plate(tmp_path / "plate.ply", material)
    middle = material.lit_mm.reshape(-1, 2).mean(0)
    for entry, leaving in ((0, 0), (60, 0), (0, 70), (45, 30)):
        down = [np.sin(np.radians(entry)), 0, -np.cos(np.radians(entry))]
        sensor = looking_at(middle, 0.02)
        away = np.array([0, np.sin(np.radians(leaving)), np.cos(np.radians(leaving))])
        sensor["to_world"] = mi.ScalarTransform4f().look_at([*middle, 0] + 5 * away, [*middle, 0], [1, 0, 0]) @ mi.ScalarTransform4f().scale([0.01, 0.01, 1])
        loaded = mi.load_dict(scene(shape, file, sensor, [EVEN | {"direction": down}], wrap="clamp"))
        found, error = mean_radiance(loaded, spp=1024)
        cosines = np.cos(np.radians([entry, leaving]))
        agrees(found, error, albedo / np.pi * cosines[0] * relative(cosines[0]) * relative(cosines[1]), 1e-4)  # f32
        loaded = mi.load_dict(scene(shape, file, sensor, [EVEN | {"direction": down}], wrap="clamp", exit_fresnel=False))
        agrees(*mean_radiance(loaded, spp=1024), albedo / np.pi * cosines[0] * relative(cosines[0]), 1e-4)


def test_under_an_even_sky_the_slab_gives_back_what_its_albedo_says(even_slab, tmp_path):
    file, material, albedo = even_slab
    shape = plate(tmp_path / "plate.ply", material)
    sensor = looking_at(material.lit_mm.reshape(-1, 2).mean(0), 0.02)
    mu = (np.arange(20_000) + 0.5) / 20_000
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
    expected = albedo * (2 * mu * relative(mu)).mean()
    agrees(*mean_radiance(mi.load_dict(scene(shape, file, sensor, [sky], wrap="clamp"))), expected, 1e-4)
    # The coat adds the sky's reflection, F at normal incidence: a smooth one exactly. The whole stays below the sky.
    smooth = mean_radiance(mi.load_dict(scene(shape, file, sensor, [sky], wrap="clamp", coat=True, alpha=0)))
    agrees(*smooth, expected + fresnel(1.0), 1e-3)
    rough = mean_radiance(mi.load_dict(scene(shape, file, sensor, [sky], wrap="clamp", coat=True, alpha=0.2)))
    assert (expected < rough[0]).all() and (rough[0] < 1).all()


def test_drawing_among_candidates_changes_the_noise_and_not_the_mean(material, slab, tmp_path):
    shape = plate(tmp_path / "plate.ply", material)
    x0, x1, y0, y1 = material.lit_extent_mm
    sensor = looking_at([x0 + 0.4 * (x1 - x0), (y0 + y1) / 2], 0.02)
    found = []
    for candidates in (1, 4):
        given = scene(shape, slab, sensor, [EVEN])
        given["integrator"]["candidates"] = candidates
        found.append(mean_radiance(mi.load_dict(given)))
    agrees(found[0][0], np.hypot(found[0][1], found[1][1]), found[1][0])
    assert (found[1][1] < 0.9 * found[0][1]).any()


def test_tiles_repeat_and_mirror_without_a_step_between_them(tmp_path):
    folder, (ny, nx) = tmp_path, (8, 10)
    fall = 0.02 * np.exp(-np.hypot(*np.mgrid[-3:4, -4:5])[..., None] * [0.6, 0.8, 1.1])
    bright = np.linspace(0.4, 1, nx)[None, :] * np.linspace(1, 0.6, ny)[:, None]
    acquire.write_matrix(folder / "ramp.rd.zarr", bright[..., None, None, None] * fall, pitch_mm=0.5)
    material = acquire.factor(folder / "ramp.rd.zarr", terms=1)
    material.save(folder / "ramp.safetensors")
    shape = plate(folder / "plate.ply", material, margin=30)
    x0, x1, y0, y1 = material.lit_extent_mm
    width, height = x1 - x0, y1 - y0

    def at(u, v, wrap):
        sensor = looking_at([x0 + u * width, y0 + v * height], 0.02)
        return mean_radiance(mi.load_dict(scene(shape, folder / "ramp.safetensors", sensor, [EVEN], wrap=wrap)), spp=1024)

    def same(a, b):
        agrees(a[0], np.hypot(a[1], b[1]), b[0], 1e-4)

    for wrap, other in (("repeat", (1.3, -1.6)), ("mirror", (1.7, -0.4))):
        same(at(0.3, 0.4, wrap), at(*other, wrap))
        # Over the tiles' side, 1e-3 of a tile apart: the light moves by 5e-3 mm of a window of 4 mm.
        for u, v in ((1.0, 0.3), (0.6, 0.0)):
            before, after = (at(u + s * 5e-4 * (u == 1), v + s * 5e-4 * (u != 1), wrap) for s in (-1, 1))
            agrees(before[0], np.hypot(before[1], after[1]), after[0], 5e-3)
    # Even light, mean over a tile: the tile's mean albedo, whatever is next to it.
    albedo = (bright[..., None, None, None] * fall).sum((2, 3)).mean((0, 1)) * 0.5**2
    loaded = mi.load_dict(scene(shape, folder / "ramp.safetensors", looking_at([(x0 + x1) / 2, (y0 + y1) / 2], width, 64), [EVEN], wrap="mirror"))
    picture = np.array(mi.render(loaded, spp=64))
    rows = np.abs((np.arange(64) + 0.5) / 64 - 0.5) * width < height / 2
    np.testing.assert_allclose(picture[rows].mean((0, 1)) * np.pi, albedo, rtol=5e-3)  # noise of 2e5 paths, rows cut at the tile's side
    # 2.5 mm beyond the lit area, further than half a window.
    assert (at(1.5, 0.5, "none")[0] == 0).all() and (at(1.5, 0.5, "clamp")[0] > 0).all()


@pytest.mark.parametrize("how", [dict(model="joint", terms=6, maps=True), dict(model="tucker", terms=4, degree=3), dict(model="peers2006", terms=3)], ids=lambda h: h["model"])
def test_factors_on_the_device_are_the_material_s_rows(truth, tmp_path, how):
    from acquire.mitsuba._factors import Factors

    material = acquire.factor(truth, **how)
    w, h = material.info["window"]
    y, x = np.mgrid[0:h, 0:w]
    for index in (0, 37, 79):
        place = material.lit_mm.reshape(-1, 2)[index]
        exit_mm = place + material.info["pitch_mm"] * np.stack([x - w // 2, y - h // 2], -1).reshape(-1, 2)
        factors = Factors(material, "none")
        found = factors.response(mi.UInt32(np.full(w * h, index)), mi.Int32(x.ravel()), mi.Int32(y.ravel()), mi.Point2f(*exit_mm.T.astype(np.float32)))
        expected = material.row(index)
        # f32 sums of f32 factors, places within 1e-6 of 10 mm.
        np.testing.assert_allclose(np.array(found).T.reshape(h, w, 3), expected, rtol=1e-4, atol=2e-6 * expected.max())


def test_a_matrix_is_the_reference_that_its_material_comes_near(truth, material, slab, tmp_path):
    shape = plate(tmp_path / "plate.ply", material)
    x0, x1, y0, y1 = material.lit_extent_mm
    for file in (truth, slab):
        loaded = mi.load_dict(scene(shape, file, looking_at([(x0 + x1) / 2, (y0 + y1) / 2], 0.02), [EVEN], wrap="clamp"))
        found, error = mean_radiance(loaded)
        if file == truth:
            of_matrix = found
            from acquire.mitsuba._factors import Table

            rows = acquire.Matrix.open(truth).read(37, 38).response[0]
            h, w, _ = rows.shape
            y, x = (v.ravel() for v in np.mgrid[0:h, 0:w])
            table = Table(acquire.Matrix.open(truth), "none").response(mi.UInt32(np.full(w * h, 37)), mi.Int32(x), mi.Int32(y), None)
            np.testing.assert_array_equal(np.array(table).T.reshape(h, w, 3), rows)
    # The material's maps make it exact under even light, to its rel_rmse at the edges of the squares.
    agrees(found, error, of_matrix, 0.02)
    with pytest.raises(acquire.InputError, match="expected a material, found the matrix"):
        quad = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
        mesh("quad", quad, np.array(quad)[:, :2], [[0, 1, 2], [0, 2, 3]]).write_ply(str(tmp_path / "quad.ply"))
        acquire.mitsuba.bake(mi.load_dict(scene(str(tmp_path / "quad.ply"), truth, looking_at([0, 0], 1), [EVEN], mm_per_uv=20.0)))


def test_scalar_and_llvm_agree(material, slab, tmp_path):
    shape = plate(tmp_path / "plate.ply", material)
    x0, x1, y0, y1 = material.lit_extent_mm
    found = []
    for variant, spp, candidates in (("llvm_ad_rgb", 4096, 1), ("scalar_rgb", 64, 2)):
        acquire.mitsuba.use(variant)
        given = scene(shape, slab, looking_at([(x0 + x1) / 2, y0 + 0.4 * (y1 - y0)], 0.02), [EVEN, {"type": "constant"}], wrap="mirror", coat=True)
        given["integrator"]["candidates"] = candidates
        found.append(mean_radiance(mi.load_dict(given), spp=spp))
    agrees(found[1][0], np.hypot(found[0][1], found[1][1]), found[0][0])
    assert (found[1][1] < 0.1 * found[1][0]).all()


BOX = {"type": "scene", "integrator": {"type": "acquire_path"}}


def test_a_step_over_an_edge_or_into_a_corner_keeps_its_length(slab):
    from acquire.mitsuba._integrator import entry_point

    of_slab = {"type": "acquire_slab", "filename": str(slab), "mm_per_uv": MM_PER_UV}
    for shape, z, height in (("cube", 1.0, -1), ("corner", 0.0, 1)):
        if shape == "cube":  # from −1 to 1
            parts = {"a": {"type": "cube", "bsdf": of_slab}}
        else:  # floor z = 0, wall x = 1 that faces −x
            wall = mi.ScalarTransform4f().translate([1, 0, 1]) @ mi.ScalarTransform4f().rotate([0, 1, 0], -90)
            parts = {"a": {"type": "rectangle", "bsdf": of_slab | {"id": "one"}}, "b": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "ref", "id": "one"}}}
        loaded = mi.load_dict(BOX | parts)
        si = loaded.ray_intersect(mi.Ray3f([0.8, 0.1, z + 0.5], [0, 0, -1]))
        one = loaded.shapes()[0].bsdf()
        for step, expected in (([-0.3, 0.2, 0], [0.5, 0.3, z]), ([0.5, 0, 0], [1, 0.1, z + height * 0.3])):
            entry, found = entry_point(loaded, one, si, mi.Vector3f(step), mi.Bool(True))
            # Probes start 1e-3 of the step's length off the plane.
            assert found[0] and np.abs(np.array(entry.p).ravel() - expected).max() < 2e-3
    # Beyond a sheet's rim there is nothing.
    loaded = mi.load_dict(BOX | {"a": {"type": "rectangle", "bsdf": of_slab}})
    si = loaded.ray_intersect(mi.Ray3f([0.8, 0.1, 0.5], [0, 0, -1]))
    assert not entry_point(loaded, loaded.shapes()[0].bsdf(), si, mi.Vector3f(0.5, 0, 0), mi.Bool(True))[1][0]


def test_what_a_scene_lacks_is_told_in_a_sentence(material, slab, tmp_path):
    quad, faces = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    upright = [[0, 0], [1, 0], [1, 1], [0, 1]]

    def render(uv, **slab_has):
        path = tmp_path / "made.ply"
        mesh("made", quad, uv, faces).write_ply(str(path))
        return acquire.mitsuba.render(mi.load_dict(scene(str(path), slab, looking_at([0.5, 0.5], 1), [EVEN], **slab_has)), spp=1)

    with pytest.raises(acquire.InputError, match="expected UVs, found none"):
        render(None)
    with pytest.raises(acquire.InputError, match="UVs without area"):
        render([[0, 0]] * 4)
    with pytest.raises(acquire.InputError, match="material is larger than the mesh; raise mm_per_uv"):
        render(upright, mm_per_uv=1.0)
    with pytest.warns(UserWarning, match=r"\d\.\d % of its area has inverted UVs, .* mirror image of the material"):
        render([[0, 0], [1, 0], [1, 1], [1, 0.1]], mm_per_uv=50.0)
    with pytest.warns(UserWarning, match="shows .* mm of"):
        render(upright, mm_per_uv=3.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        render(upright, mm_per_uv=50.0)
    with pytest.raises(acquire.InputError, match="expected a shape, found none"):
        acquire.mitsuba.render(mi.load_dict(BOX | {"sensor": looking_at([0, 0], 1)}), spp=1)
    with pytest.raises(acquire.InputError, match="expected a shape with the bsdf acquire_slab"):
        acquire.mitsuba.render(mi.load_dict(BOX | {"sensor": looking_at([0, 0], 1), "a": {"type": "sphere"}}), spp=1)
    # What Mitsuba's parser passes on is a RuntimeError with our words.
    for wrong, words in (
        (dict(mm_per_uv=-1.0), "mm_per_uv: expected a number above|mm_per_uv: expected a number from above 0"),
        (dict(wrap="tiled"), "expected one of repeat, mirror, clamp, none"),
        (dict(alpha=2.0), "alpha: expected"),
        (dict(filename="nowhere.safetensors"), "nowhere.safetensors"),
        (dict(mm_per_uvs=1.0), "mm_per_uvs"),
    ):
        with pytest.raises(RuntimeError, match=words):
            render(upright, **wrong)


def ball(path, inwards=False, normals=None, n=12):
    """A closed ball of radius 8 mm around (0, 0, 8) with UVs 0…1, 20 mm a unit; ``normals``: of its vertices, times that away from its middle."""
    v, u = (w.ravel() for w in np.meshgrid(np.linspace(0.02, 0.98, n), np.linspace(0, 1, 2 * n), indexing="ij"))
    away = np.stack([np.sin(np.pi * v) * np.cos(2 * np.pi * u), np.sin(np.pi * v) * np.sin(2 * np.pi * u), np.cos(np.pi * v)], -1)
    first = (np.arange(n - 1)[:, None] * 2 * n + np.arange(2 * n - 1)).ravel()
    faces = np.concatenate([np.stack([first, first + 2 * n, first + 2 * n + 1], -1), np.stack([first, first + 2 * n + 1, first + 1], -1)])
    faces = faces[:, ::-1] if inwards else faces
    mesh("ball", 8 * away + [0, 0, 8], np.stack([u, v], -1), faces, None if normals is None else normals * away).write_ply(str(path))
    return str(path)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
def test_a_shape_that_would_be_black_because_it_looks_inwards_is_refused(slab, tmp_path, variant):
    acquire.mitsuba.use(variant)
    sky = {"type": "constant"}

    def loaded(shape, sensor, **more):
        made = scene(shape, slab, sensor, [sky], mm_per_uv=20.0, wrap="mirror")
        made["slab"] |= more
        return mi.load_dict(made)

    sensor = looking_at([0, 0], 12, pixels=4)
    sensor["to_world"] = mi.ScalarTransform4f().look_at([30, 9, 20], [0, 0, 8], [0, 0, 1]) @ mi.ScalarTransform4f().scale([6, 6, 1])
    inwards = ball(tmp_path / "inwards.ply", inwards=True)
    with pytest.raises(acquire.InputError, match=r"shape slab: of \d+ places .*, \d+ are on its inside: .* set flip_normals in Mitsuba"):
        acquire.mitsuba.render(loaded(inwards, sensor), spp=4)
    # Mitsuba's own call has the same sentence.
    with pytest.raises((acquire.InputError, RuntimeError)) as told:
        mi.render(loaded(inwards, sensor), spp=4)
    assert "flip_normals" in str(told.value) + str(told.value.__cause__)
    # What it advises is what helps.
    picture = np.array(acquire.mitsuba.render(loaded(inwards, sensor, flip_normals=True), spp=4))
    assert (picture.mean((0, 1)) > 0.05).all()
    against = ball(tmp_path / "against.ply", normals=-1)
    with pytest.raises(acquire.InputError, match=r"shape slab: of \d+ places .*, \d+ have vertex normals that point to the inside; set face_normals"):
        acquire.mitsuba.render(loaded(against, sensor), spp=4)
    for shape, more in ((against, dict(face_normals=True)), (ball(tmp_path / "right.ply", normals=1), {})):
        assert (np.array(acquire.mitsuba.render(loaded(shape, sensor, **more), spp=4)).mean((0, 1)) > 0.05).all()
    # From within a room its walls look inwards, as they should.
    within = looking_at([0, 0], 1, pixels=4)
    within["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 8], [8, 0, 8], [0, 0, 1])
    acquire.mitsuba.render(loaded(inwards, within), spp=1)


def test_a_bake_of_a_mesh_that_looks_inwards_is_refused(slab, tmp_path):
    def baked(shape, **more):
        made = scene(shape, slab, looking_at([0, 0], 1), [{"type": "constant"}], mm_per_uv=20.0, wrap="mirror")
        del made["sensor"]
        made["slab"] |= more
        return acquire.mitsuba.bake(mi.load_dict(made), spp=4, size=24)

    inwards, against = ball(tmp_path / "inwards.ply", inwards=True), ball(tmp_path / "against.ply", normals=-1)
    with pytest.raises(acquire.InputError, match=r"shape slab: of \d+ texels, \d+ are dark and \d+ have the mesh itself before them: .* set flip_normals"):
        baked(inwards)
    with pytest.raises(acquire.InputError, match=r"shape slab: of \d+ texels, \d+ have vertex normals against their faces: set face_normals"):
        baked(against)
    assert baked(inwards, flip_normals=True).exitance.mean() > 0.1
    assert baked(against, face_normals=True).exitance.mean() > 0.1


def test_an_llvm_that_would_abort_is_refused_before_it_does(tmp_path, monkeypatch):
    from acquire.mitsuba import _variants

    old = tmp_path / "libLLVM-14.so.1"
    old.touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(old))
    with pytest.raises(acquire.InputError, match="LLVM 16 or later, found .*libLLVM-14.*libllvm19"):
        acquire.mitsuba.use("llvm_ad_rgb")
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH")
    monkeypatch.setattr(_variants, "_PLACES", (str(tmp_path / "*"),))
    with pytest.raises(acquire.InputError, match="libllvm19"):
        acquire.mitsuba.find_llvm()
    (tmp_path / "libLLVM.so.19.1").touch()
    assert acquire.mitsuba.find_llvm().endswith("libLLVM.so.19.1")
    with pytest.raises(acquire.InputError, match="llvm_ad_rgb"):
        acquire.mitsuba.use("llvm_ad_spectral")
    with pytest.raises(acquire.InputError, match="variant: expected one of"):
        acquire.mitsuba.use("gpu")


def test_a_scene_in_xml_with_two_materials_renders(material, slab, even_slab, tmp_path):
    shape = plate(tmp_path / "plate.ply", material, margin=1)
    (tmp_path / "scene.xml").write_text(f"""
        <scene version="3.0.0">
            <integrator type="acquire_path"><integer name="max_depth" value="3"/></integrator>
            <sensor type="perspective">
                <transform name="to_world"><lookat origin="3, 3, 40" target="3, 3, 0" up="0, 1, 0"/></transform>
                <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/></film>
            </sensor>
            <emitter type="constant"/>
            <shape type="ply"><string name="filename" value="{shape}"/>
                <bsdf type="acquire_slab"><string name="filename" value="{slab}"/><float name="mm_per_uv" value="{MM_PER_UV}"/>
                    <string name="wrap" value="mirror"/><float name="int_ior" value="1.3"/></bsdf></shape>
            <shape type="sphere"><point name="center" x="3" y="3" z="3"/><float name="radius" value="2"/>
                <bsdf type="acquire_slab"><string name="filename" value="{even_slab[0]}"/><float name="mm_per_uv" value="12"/></bsdf></shape>
            <shape type="rectangle"><transform name="to_world"><scale value="30"/><translate z="-2"/></transform><bsdf type="diffuse"/></shape>
        </scene>""")
    picture = np.array(mi.render(mi.load_file(str(tmp_path / "scene.xml")), spp=64))
    assert np.isfinite(picture).all() and (picture > 0).all()
    sphere, floor = picture[8, 12], picture[1, 1]
    assert (sphere < 0.9).all() and floor == pytest.approx(0.5, abs=0.1)


@pytest.fixture(scope="module")
def baked_plate(material, slab, tmp_path_factory):
    """A plate of 12 mm over uv 0…1 under a spot and a sky, its tiles mirrored: the loaded scene, its light, its bake and where that is."""
    folder = tmp_path_factory.mktemp("bake")
    acquire.mitsuba.use("llvm_ad_rgb")
    places = np.array([[0, 0, 0], [12, 0, 0], [12, 12, 0], [0, 12, 0]])
    mesh("plate", places, places[:, :2] / 12, [[0, 1, 2], [0, 2, 3]]).write_ply(str(folder / "plate.ply"))
    spot = {"type": "spot", "to_world": mi.ScalarTransform4f().look_at([5, 7, 30], [5, 7, 0], [0, 1, 0]), "intensity": 1000.0, "cutoff_angle": 9}
    lights = [spot, {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}]

    def seen(place):
        of_slab = dict(wrap="mirror", mm_per_uv=12.0, exit_fresnel=False)
        return mi.load_dict(scene(str(folder / "plate.ply"), slab, looking_at(place, 0.02), lights, **of_slab))

    return seen, acquire.mitsuba.bake(seen([6, 6]), folder / "out", spp=256), folder / "out"


def test_a_bake_is_what_is_seen_hit_by_hit(baked_plate):
    seen, baked, _ = baked_plate
    size = len(baked.exitance)
    assert size == 48 and baked.covered.all()
    for column, line in ((20, 28), (30, 27), (15, 34), (36, 13)):
        place = (np.array([column, line]) + 0.5) * 12 / size
        found, error = mean_radiance(seen(place))
        # All further from the rim than light spreads. Irradiance is a mean over texels of 0.25 mm, interpolated, with noise of its own.
        agrees(found, error, baked.exitance[line, column] / np.pi, 0.02)


def test_a_bake_s_files_open_and_shine(baked_plate, slab):
    import json
    import struct

    seen, baked, folder = baked_plate
    names = "albedo.exr albedo.png bake.json blender.py exitance.exr irradiance.exr mesh.ply radiance.exr radiance.png scene.xml slab.glb"
    assert sorted(p.name for p in folder.iterdir()) == names.split()
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(folder / "exitance.exr")).convert(component_format=mi.Struct.Type.Float32)), baked.exitance)
    glb = (folder / "slab.glb").read_bytes()
    magic, version, length, of_json, kind = struct.unpack_from("<4sIIII", glb)
    assert (magic, version, length, kind) == (b"glTF", 2, len(glb), 0x4E4F534A)
    tree, body = json.loads(glb[20 : 20 + of_json]), glb[28 + of_json :]
    assert len(body) == tree["buffers"][0]["byteLength"]
    view = tree["bufferViews"][3]
    assert body[view["byteOffset"] :][: view["byteLength"]] == (folder / "radiance.png").read_bytes()
    uv = np.frombuffer(body, "<f4", 8, tree["bufferViews"][1]["byteOffset"])
    assert uv.tolist() == [0, 0, 1, 0, 1, 1, 0, 1]
    compile((folder / "blender.py").read_text(), "blender.py", "exec")
    picture = np.array(mi.render(mi.load_file(str(folder / "scene.xml")), spp=16))
    # The brightest pixel sees the brightest texels.
    assert picture[..., 1].max() == pytest.approx(baked.exitance[..., 1].max() / np.pi, rel=0.05)


def test_a_bake_that_cannot_be_is_refused(baked_plate, even_slab, tmp_path):
    seen, _, folder = baked_plate
    with pytest.raises(acquire.InputError, match="force=True"):
        acquire.mitsuba.bake(seen([6, 6]), folder, spp=1, size=8)
    acquire.mitsuba.bake(seen([6, 6]), folder.parent / "again", spp=1, size=8)
    acquire.mitsuba.bake(seen([6, 6]), folder.parent / "again", spp=1, size=8, force=True)
    (tmp_path / "theirs.txt").write_text("keep")
    with pytest.raises(acquire.InputError, match="other files"):
        acquire.mitsuba.bake(seen([6, 6]), tmp_path, spp=1, size=8, force=True)
    with pytest.raises(acquire.InputError, match="expected one mesh .* and the id other, found none"):
        acquire.mitsuba.bake(seen([6, 6]), shape="other")
    file, material, _ = even_slab
    shape = plate(tmp_path / "plate.ply", material)
    with pytest.raises(acquire.InputError, match="expected UVs from 0 to 1"):
        acquire.mitsuba.bake(mi.load_dict(scene(shape, file, looking_at([0, 0], 1), [EVEN])))
    with pytest.raises(acquire.InputError, match="bake: expected the wrap repeat, mirror or none, found clamp"):
        quad = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
        mesh("quad", quad, np.array(quad)[:, :2], [[0, 1, 2], [0, 2, 3]]).write_ply(str(tmp_path / "quad.ply"))
        acquire.mitsuba.bake(mi.load_dict(scene(str(tmp_path / "quad.ply"), file, looking_at([0, 0], 1), [EVEN], wrap="clamp", mm_per_uv=30.0)))


def test_light_beside_the_charts_is_that_of_the_nearest_texels():
    from acquire.mitsuba._bake import _spread

    image = np.zeros((7, 9, 3), np.float32)
    covered = np.zeros((7, 9), bool)
    covered[2:5, 3:5] = True
    image[covered] = 2.0
    found = _spread(image, covered, 3)
    assert (found[:, 0:8][np.add.outer([2, 1, 0, 0, 0, 1, 2], [3, 2, 1, 0, 0, 1, 2, 3]) <= 3] == 2).all()
    assert (found[0, 0] == 0).all() and (found[6, 8] == 0).all()
