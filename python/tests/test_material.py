"""Materials: evaluated, drawn from, relit, saved."""

import pickle
import threading

import numpy as np
import pytest

import acquire


def test_a_row_is_the_response_at_its_lit_point(material):
    w, h = material.info["window"]
    pitch = material.info["pitch_mm"]
    index = 23
    x, y = index % 10, index // 10
    at = material.lit_mm[y, x]
    dy, dx = np.mgrid[0:h, 0:w]
    offsets = np.stack([dx - w // 2, dy - h // 2], -1).reshape(-1, 2) * pitch
    row = material.row(index)
    assert row.shape == (h, w, 3) and row.dtype == np.float32
    # At lit points and samples interpolation changes nothing but rounding; lit points lie on their lattice to the drift, 0.1 px of 6 px a sample.
    nearest = material.response(at, at + offsets, interpolate=False)
    np.testing.assert_allclose(nearest.reshape(h, w, 3), row, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(material.rows([index, -1])[0], row)


def test_points_broadcast_and_shapes_are_checked(material):
    one = material.response([1.0, 1.2], [[1.0, 1.2], [1.5, 1.2]])
    assert one.shape == (2, 3)
    assert material.response(np.zeros((0, 2)), np.zeros((0, 2))).shape == (0, 3)
    far = material.response([1e6, 0], [0, 0])
    assert (far == 0).all()
    for x_i, x_o in (([1, 2, 3], [1, 2]), (1.0, [1, 2]), (np.zeros((2, 2)), np.zeros((3, 2)))):
        with pytest.raises(acquire.InputError, match="x_i|x_o"):
            material.response(x_i, x_o)
    with pytest.raises(acquire.InputError, match="from 0 to below 80"):
        material.row(80)


def test_many_pairs_are_those_one_by_one(material):
    rng = np.random.default_rng(1)
    x0, x1, y0, y1 = material.lit_extent_mm
    x_i = rng.uniform([x0, y0], [x1, y1], (20_000, 2))
    x_o = x_i + rng.normal(0, 1, x_i.shape)
    many = material.response(x_i, x_o)
    for k in range(0, 20_000, 997):
        np.testing.assert_array_equal(many[k], material.response(x_i[k], x_o[k])[0])


def test_an_image_in_millimetres_lies_along_the_axes_of_the_slab_also_where_the_lattice_is_turned(tmp_path):
    path = tmp_path / "m.rd.zarr"
    row = np.zeros((1, 1))
    row[0, 0] = 1.0
    y, x = np.mgrid[0:30, 0:40] * 0.5
    turn = np.deg2rad(10)
    x_i, y_i = x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)
    acquire.write_matrix(path, np.broadcast_to(row, (30, 40, 1, 1)), pitch_mm=0.25, x_i_mm=x_i, y_i_mm=y_i)
    sharp = acquire.factor(path, terms=1)
    # A strip 2 mm wide at a constant x, in the middle of a lit area of 20 x 15 mm.
    middle = x_i.mean()
    lit = sharp.relight(np.ones((1, 1, 3)), extent_mm=(middle - 1, middle + 1, y_i.mean() - 4, y_i.mean() + 4))
    total = lit.values[..., 1]
    x_mm, y_mm = np.asarray(lit.x_mm), np.asarray(lit.y_mm)
    for at in (-3, 0, 3):
        line = total[np.abs(y_mm - y_i.mean() - at) < 0.6].sum(axis=0)
        centre = (line * x_mm).sum() / line.sum()
        # Cells of 0.5 mm; turned by 10 degrees with the lattice it would be 0.53 mm aside 3 mm from the middle.
        assert abs(centre - middle) < 0.15, (at, centre - middle)


def test_draws_estimate_the_row_s_integral(material):
    n, index = 40_000, 12
    offsets, densities = material.sample(index, n, seed=7)
    assert offsets.shape == (n, 2) and densities.shape == (n,)
    np.testing.assert_array_equal(material.sample(index, n, seed=7)[0], offsets)
    np.testing.assert_allclose(material.density(index, offsets), densities)
    at = material.lit_mm.reshape(-1, 2)[index]
    estimate = material.response(np.broadcast_to(at, (n, 2)), at + offsets, interpolate=False)[:, 1] / densities
    exact = material.row(index)[..., 1].sum() * material.info["pitch_mm"] ** 2
    # Five standard errors: one run in two million fails by chance.
    assert abs(estimate.mean() - exact) < 5 * estimate.std() / np.sqrt(n)
    # The same by the place.
    np.testing.assert_array_equal(material.sample(at, 10, seed=7)[0], material.sample(index, 10, seed=7)[0])


def test_even_light_on_an_even_slab_leaves_as_its_albedo(tmp_path):
    path = tmp_path / "m.rd.zarr"
    row = 0.01 * np.exp(-np.hypot(*np.mgrid[-4:5, -4:5]))
    acquire.write_matrix(path, np.broadcast_to(row, (12, 10, 9, 9)), pitch_mm=0.5)
    even = acquire.factor(path, terms=1)
    lit = even.relight(np.ones((12, 10)))
    albedo = row.sum() * 0.5**2
    middle = lit.values[len(lit.y_mm) // 2, len(lit.x_mm) // 2]
    np.testing.assert_allclose(middle, albedo, rtol=1e-5)  # f32 factors
    assert lit.values.shape == (len(lit.y_mm), len(lit.x_mm), 3)
    # Twice the light, over the half of the slab: what leaves in all is the same. One pixel over an extent is that light.
    x0, x1, y0, y1 = even.lit_extent_mm
    half = even.relight(np.full((1, 1, 3), 2.0), extent_mm=(x0, (x0 + x1) / 2, y0, y1))
    np.testing.assert_allclose(half.values.sum(), lit.values.sum(), rtol=1e-5)
    assert half.values[:, : len(lit.x_mm) // 3].sum() > 10 * half.values[:, 2 * len(lit.x_mm) // 3 :].sum()
    for wrong in ((0, 0, 0, 1), (1, 0, 0, 1), (0, np.nan, 0, 1)):
        with pytest.raises(acquire.InputError, match="extent_mm"):
            even.relight(np.ones((2, 2)), extent_mm=wrong)
    for wrong in ((0, 1), (11, 1), (1, 2, 3)):
        with pytest.raises(acquire.InputError, match="tile"):
            even.relight(np.ones((2, 2)), extent_mm=(x0, x1, y0, y1), tile=wrong)
    # Over the lit area copies of a square picture are those of it over its extent.
    square = np.random.default_rng(1).random((2, 2, 3))
    whole = even.relight(square, extent_mm=(x0, x1, y0, y1), tile=(5, 6)).values
    np.testing.assert_allclose(even.relight(square, tile=(5, 6)).values, whole, atol=1e-5 * whole.max())  # f32 means
    np.testing.assert_allclose(even.relight(np.tile(square, (6, 5, 1))).values, whole, atol=1e-5 * whole.max())
    with pytest.warns(acquire.FindingWarning, match="0.833 times") as told:
        even.relight(np.ones((40, 80)))
    assert told[0].message.finding["id"] == "light-stretched" and told[0].message.finding["figures"]["image_ratio"] == 2
    with pytest.raises(acquire.InputError, match="irradiance"):
        even.relight(np.full((2, 2), np.nan))


def test_a_light_is_that_of_the_command_line(material, tmp_path, program):
    name = tmp_path / "m.safetensors"
    material.save(name)
    status, _, said = program("relight", name, "--light", "gradient", "--out", tmp_path / "e.exr")
    assert status == 0, said
    # `gradient` is the irradiance u = 0 … 1 along x at the middle of each cell; a ramp of many pixels has the same means.
    ramp = (np.arange(4000) + 0.5) / 4000
    ours = material.relight(ramp[None])
    columns, lines = len(ours.x_mm), len(ours.y_mm)
    assert f"{columns} × {lines} samples" in said
    white = float(said.split("white is an exitance of ")[1].split(")")[0])
    # The 99.5th percentile of all numbers, to four places.
    found = np.sort(ours.values.ravel())[ours.values.size * 995 // 1000]
    assert abs(found - white) < 1e-3 * white


def test_files_and_bytes_come_back(material, tmp_path):
    for precision, bound in (("f32", 1e-7), ("f16", 2e-3), ("coded", 1e-2)):  # places are f32 in files
        name = tmp_path / f"{precision}.{'acq' if precision == 'coded' else 'safetensors'}"
        material.save(name, None if precision == "coded" else precision)
        back = acquire.Material.load(name)
        worst = np.abs(back.row(5) - material.row(5)).max() / material.row(5).max()
        assert worst <= bound, (precision, worst)
        np.testing.assert_array_equal(acquire.Material.load(name.read_bytes()).row(5), back.row(5))
    assert acquire.Material.load(material.to_bytes()).info == material.info
    np.testing.assert_allclose(pickle.loads(pickle.dumps(material)).row(5), material.row(5), rtol=1e-6)
    factors = material.factors
    assert factors["lit_mm"].shape == (80, 2) and factors["incident_factors"].shape[1:] == (80, 6)
    material.export(tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as exported:
        for key in ("weights", "incident_factors", "offset_factors", "shift"):
            np.testing.assert_array_equal(exported[key], factors[key])
    # Nothing is replaced unasked, and nothing of others.
    with pytest.raises(acquire.InputError, match="force=True"):
        material.export(tmp_path / "m.npz")
    material.export(tmp_path / "m.npz", force=True)
    with pytest.raises(acquire.InputError, match="force=True"):
        material.save(tmp_path / "f32.safetensors", "f32")
    material.save(tmp_path / "f32.safetensors", "f32", force=True)
    for write in (lambda path: material.export(path, force=True), lambda path: material.save(path, "f32", force=True)):
        for name in ("theirs.npz", "theirs.safetensors"):
            (tmp_path / name).write_bytes(b"keep")
            with pytest.raises(acquire.InputError):
                write(tmp_path / name)
            assert (tmp_path / name).read_bytes() == b"keep"
    with pytest.raises(acquire.InputError, match="npz or .exr"):
        material.export(tmp_path / "m.mat")
    with pytest.raises(acquire.InputError, match="precision: expected one of"):
        material.save(tmp_path / "m.safetensors", "f8")


def test_what_is_no_material_is_refused(tmp_path):
    with pytest.raises(acquire.InputError) as raised:
        acquire.Material.load(tmp_path / "none.safetensors")
    assert raised.value.kind == "Io" and "none.safetensors" in str(raised.value)
    (tmp_path / "cut.safetensors").write_bytes(b"{}")
    with pytest.raises(acquire.InputError, match="cut.safetensors"):
        acquire.Material.load(tmp_path / "cut.safetensors")
    with pytest.raises(acquire.InputError, match="bytes"):
        acquire.Material.load(b"{}")
    assert issubclass(acquire.InputError, acquire.Error) and not issubclass(acquire.InternalError, acquire.InputError)


def test_threads_evaluate_side_by_side(material):
    rng = np.random.default_rng(2)
    x = rng.uniform(0, 4, (100_000, 2))
    expected = material.response(x, x[::-1].copy())
    found = {}

    def work(k):
        found[k] = material.response(x, x[::-1].copy())

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(found[k], expected) for k in range(4))
