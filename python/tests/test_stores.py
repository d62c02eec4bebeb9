"""Stores that zarr-python, xarray and dask write are read here, and ours there."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import acquire
from conftest import ROOT, windows

zarr = pytest.importorskip("zarr", minversion="3")
xr = pytest.importorskip("xarray")
pytest.importorskip("dask")

NAMES = ["y_i", "x_i", "dy", "dx", "channel"]


def dataset(response, **more):
    ny, nx, h, w, _ = response.shape
    return xr.Dataset(
        {"response": (NAMES, response), **more},
        coords={"dx": 0.5 * (np.arange(w) - w // 2), "dy": 0.5 * (np.arange(h) - h // 2)},
        attrs={"pitch_mm": 0.5},
    )


def test_ours_opens_in_xarray_and_means_skip_what_was_not_measured(tmp_path):
    response = windows()
    response[1, 2, 2, 3] = np.nan  # a masked peak
    acquire.write_matrix(tmp_path / "m.rd.zarr", response, pitch_mm=0.5, variance=np.full_like(response, 1e-6))
    matrix = acquire.Matrix.open(tmp_path / "m.rd.zarr")
    lazy = matrix.to_xarray()
    assert lazy.response.dims == tuple(NAMES) and lazy.sizes == {"y_i": 3, "x_i": 4, "dy": 5, "dx": 7, "channel": 3}
    np.testing.assert_array_equal(lazy.response.values, response)
    assert np.isnan(lazy.variance.values[1, 2, 2, 3]).all() and (lazy.valid.values[1, 2, 2, 3] == 0).all()
    # README's line: what leaves where light enters, over the slab.
    peaks = lazy.response.sel(dx=0, dy=0).mean(("y_i", "x_i", "channel"))
    assert float(peaks) == pytest.approx(np.nanmean(response[:, :, 2, 3]), rel=1e-6)
    assert "points" not in lazy.attrs and "window" not in lazy.attrs
    np.testing.assert_array_equal(matrix.response, response)
    rows = matrix.read(6, 8)
    assert not rows.valid[0, 2, 3].any() and np.isnan(rows.variance[0, 2, 3]).all()


def test_ours_in_shards_opens_in_zarr_python(tmp_path):
    # A line of points is a chunk at least: 1,025 lines are more than files of their own are made for.
    response = (0.2 * np.random.default_rng(3).random((1025, 2, 3, 5, 3))).astype("f4")
    response[700, 1, 2, 4] = np.nan
    acquire.write_matrix(tmp_path / "m.rd.zarr", response, pitch_mm=0.5)
    array = zarr.open_group(tmp_path / "m.rd.zarr", mode="r")["response"]
    assert (array.chunks, array.shards) == ((1, 2, 3, 5, 3), (32, 2, 3, 5, 3))
    assert len(list((tmp_path / "m.rd.zarr" / "response").iterdir())) == 33 + 1
    np.testing.assert_array_equal(array[:], response)
    np.testing.assert_array_equal(array[32:35, 1], response[32:35, 1])
    np.testing.assert_array_equal(acquire.Matrix.open(tmp_path / "m.rd.zarr").response, response)


CHUNKS = {
    "whole": {},
    "lines": {"y_i": 1},
    "odd": {"y_i": 2, "x_i": 3, "dy": 2, "dx": 4, "channel": 1},
}


@pytest.mark.parametrize("chunks", CHUNKS)
@pytest.mark.parametrize("zarr_format", [2, 3])
def test_xarray_and_dask_write_what_is_read(tmp_path, chunks, zarr_format):
    response = windows()
    response[0, 1] = np.nan
    places = np.mgrid[0:3, 0:4].astype(float)
    ds = dataset(response).assign_coords(x_i_mm=(("y_i", "x_i"), 1.5 * places[1]), y_i_mm=(("y_i", "x_i"), places[0]))
    ds = ds.chunk(CHUNKS[chunks]) if CHUNKS[chunks] else ds
    ds.to_zarr(tmp_path / "m.zarr", zarr_format=zarr_format)
    matrix = acquire.Matrix.open(tmp_path / "m.zarr")
    np.testing.assert_array_equal(matrix.response, response)
    assert matrix.info["lit_pitch_mm"] == [1.5, 1.0]
    np.testing.assert_array_equal(matrix.lit_mm[..., 0], 1.5 * places[1])


def codecs():
    from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, GzipCodec, TransposeCodec, ZstdCodec

    yield "none", {"compressors": None}
    yield "gzip", {"compressors": GzipCodec()}
    yield "zstd", {"compressors": ZstdCodec()}
    # numcodecs is built without snappy; tests/all/foreign_stores.rs has it.
    for name in ("lz4", "lz4hc", "blosclz", "zstd", "zlib"):
        yield f"blosc-{name}", {"compressors": BloscCodec(cname=name, shuffle="bitshuffle")}
    yield "crc32c", {"compressors": [ZstdCodec(), Crc32cCodec()]}
    yield "big-endian", {"serializer": BytesCodec(endian="big")}
    yield "transposed", {"filters": TransposeCodec(order=(4, 0, 1, 2, 3))}
    yield "sharded", {"chunks": (1, 2, 5, 7, 3), "shards": (2, 4, 5, 7, 3)}


@pytest.mark.parametrize("name, how", list(codecs()))
def test_zarr_python_writes_what_is_read(tmp_path, name, how):
    response = windows()
    group = zarr.open_group(tmp_path / "m.zarr", mode="w", attributes={"pitch_mm": 0.25})
    how = {"chunks": (2, 2, 5, 7, 3), **how}
    array = group.create_array("response", shape=response.shape, dtype="f4", dimension_names=NAMES, **how)
    array[:] = response
    matrix = acquire.Matrix.open(tmp_path / "m.zarr")
    np.testing.assert_array_equal(matrix.response, response)
    np.testing.assert_array_equal(matrix.to_xarray().response.values, response)


@pytest.mark.parametrize("kind", ["f8", "f4", "f2", ">f4"])
def test_numbers_of_every_type(tmp_path, kind):
    response = windows().astype(kind)
    group = zarr.open_group(tmp_path / "m.zarr", mode="w", attributes={"pitch_mm": 0.25}, zarr_format=2)
    group.create_array("response", data=response)
    np.testing.assert_array_equal(acquire.Matrix.open(tmp_path / "m.zarr").response, response.astype("f4"))


def test_chunks_that_zarr_python_leaves_out_are_their_fill_value(tmp_path):
    response = windows()
    response[1] = 0
    group = zarr.open_group(tmp_path / "m.zarr", mode="w", attributes={"pitch_mm": 0.25})
    array = group.create_array("response", shape=response.shape, dtype="f4", chunks=(1, 1, 5, 7, 3))
    array[:] = response
    valid = group.create_array("valid", shape=response.shape, dtype="bool", chunks=(3, 4, 5, 7, 3))
    valid[:] = True
    assert array.nchunks_initialized == 8
    np.testing.assert_array_equal(acquire.Matrix.open(tmp_path / "m.zarr").response, response)
    # All-true flags whose fill value is true leave no chunk at all.
    other = zarr.open_group(tmp_path / "o.zarr", mode="w", attributes={"pitch_mm": 0.25})
    other.create_array("response", data=response)
    flags = other.create_array("valid", shape=response.shape, dtype="u1", chunks=(1, 1, 5, 7, 3), fill_value=1)
    flags[:] = 1
    assert flags.nchunks_initialized == 0
    np.testing.assert_array_equal(acquire.Matrix.open(tmp_path / "o.zarr").response, response)


CROPS = {
    "points": dict(y_i=slice(1, 3), x_i=slice(0, 3)),
    "every other": dict(x_i=slice(None, None, 2)),
    "window": dict(dx=slice(1, -1)),
    "one side": dict(dx=slice(2, None), dy=slice(None, -1)),
    "beside": dict(dx=slice(4, None)),
    "a line": dict(y_i=1),
    "a point": dict(y_i=1, x_i=2),
    "a channel": dict(channel=1),
    "a sample": dict(dx=3, dy=2),
}


@pytest.mark.parametrize("crop", CROPS)
def test_crops_are_matrices(tmp_path, crop):
    response = windows()
    acquire.write_matrix(tmp_path / "whole.rd.zarr", response, pitch_mm=0.5, lit_pitch_mm=(1.5, 1.0))
    ds = xr.open_zarr(tmp_path / "whole.rd.zarr", consolidated=False)
    cut = ds.isel(CROPS[crop])
    cut.to_zarr(tmp_path / "cut.rd.zarr")
    matrix = acquire.Matrix.open(tmp_path / "cut.rd.zarr")
    found = matrix.response
    # At every offset the number that is stored there, and nothing where the crop has none.
    expected = cut.response.expand_dims([d for d in NAMES if d not in cut.response.dims]).transpose(*NAMES).values
    expected = np.broadcast_to(expected, (*expected.shape[:4], 3))
    half_x, half_y = matrix.window[0] // 2, matrix.window[1] // 2
    xs = np.atleast_1d(np.rint(cut.dx.values / 0.5).astype(int)) + half_x
    ys = np.atleast_1d(np.rint(cut.dy.values / 0.5).astype(int)) + half_y
    np.testing.assert_array_equal(found[:, :, ys[:, None], xs[None, :]], expected)
    assert np.isfinite(found).sum() == expected.size
    assert matrix.info["lit_pitch_mm"][0] == (3.0 if crop == "every other" else 1.5)
    np.testing.assert_allclose(matrix.lit_mm[0, 0], [np.ravel(cut.x_i_mm.values)[0], np.ravel(cut.y_i_mm.values)[0]])


def test_a_first_version_is_read(tmp_path, truth):
    # Zeros where nothing was measured, and sizes among the attributes.
    response = windows()
    acquire.write_matrix(tmp_path / "m.rd.zarr", response, pitch_mm=0.5)
    group = zarr.open_group(tmp_path / "m.rd.zarr", mode="r+")
    group.attrs.update({"acquire_format": 1, "points": [4, 3], "window": [7, 5]})
    del group.attrs["checksum"]
    valid = group["valid"][:]
    valid[2, 2, 1] = 0
    group["valid"][:] = valid
    zeros = np.where(valid == 1, response, 0)
    group["response"][:] = zeros
    group["variance"][:] = 0 * zeros
    np.testing.assert_array_equal(acquire.Matrix.open(tmp_path / "m.rd.zarr").response, np.where(valid == 1, response, np.nan))


MISTAKES = [
    (lambda ds: ds.rename(response="R"), "array response: expected an array of this name, found none"),
    (lambda ds: ds.drop_vars(["dx", "dy"]).drop_attrs(), "attribute pitch_mm"),
    (lambda ds: ds.transpose("x_i", "y_i", ...), "array response: expected dimensions y_i, x_i, dy, dx, channel in this order"),
    (lambda ds: ds.drop_vars("dx").isel(dx=slice(0, 6)), "an odd number of samples along dx, or the array dx"),
    (lambda ds: ds.isel(dx=slice(1, None, 2)), "array dx: expected offsets in mm, 0.5 mm apart"),
    (lambda ds: ds.astype("i4"), "expected numbers of type float32, float64 or float16"),
    (lambda ds: ds.isel(channel=slice(0, 2)), "1 or 3 channels, found 2"),
    (lambda ds: ds.assign_attrs(acquire_format=9), "attribute acquire_format: expected one of [1, 2, 3], or none"),
    (lambda ds: ds.assign(valid=ds.response.astype("u1") * 0 + 3), "array valid: expected 1 where measured and 0 where not, found 3"),
    (lambda ds: ds.where(ds.dx != 0, np.inf), "response: expected finite numbers, found inf at lit point [0, 0]"),
    (lambda ds: ds.assign_coords(x_i=1.5 * np.arange(4)), "array x_i: expected whole numbers, or none"),
    (lambda ds: ds.assign(response=ds.response.assign_attrs(units="cm^-2")), "array response: expected units mm^-2, found cm^-2"),
    (lambda ds: ds.assign(variance=ds.response.isel(dx=0, drop=True)), "array variance: expected the shape of response"),
]


@pytest.mark.parametrize("change, words", MISTAKES)
def test_mistakes_are_named(tmp_path, change, words):
    change(dataset(windows())).to_zarr(tmp_path / "m.zarr")
    with pytest.raises(acquire.InputError) as raised:
        acquire.Matrix.open(tmp_path / "m.zarr").read()
    assert words in str(raised.value)
    assert "incomplete or damaged" not in str(raised.value)


def blocks(page):
    return re.findall(r"```(\w+)\n(.*?)```", (ROOT / "docs" / page).read_text(), re.S)


def test_the_page_s_python_writes_stores_that_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    for kind, code in blocks("matrix-format.md"):
        if kind == "python":
            exec(compile(code, "docs/matrix-format.md", "exec"), names)
    least = [acquire.Matrix.open(f"{name}.rd.zarr") for name in ("least", "least-zarr")]
    assert all(m.points == (8, 6) and m.window == (11, 9) and m.pitch_mm == 0.5 for m in least)
    np.testing.assert_array_equal(least[0].response, least[1].response)
    # 99 samples of variance 4 beside a row's 10 % and 0.5 in all alike.
    least_set = names["xr"].open_zarr("least.rd.zarr", consolidated=False)
    over = ("dy", "dx", "channel")
    shared = least_set.assign(
        variance=4 + (0.1 * least_set.response) ** 2 + 0.25,
        row_scale_sd=(("y_i", "x_i", "channel"), np.full((6, 8, 3), 0.1)),
        common_sd=(over, np.full((9, 11, 3), 0.5)),
    )
    light = least_set.response.sum(("dy", "dx"))
    expected = 0.25 * np.sqrt(99 * 4 + (0.1 * light) ** 2 + (99 * 0.5) ** 2)
    np.testing.assert_allclose(names["albedo_sd"](shared).transpose("y_i", "x_i", "channel"), expected, rtol=1e-5)
    crop = acquire.Matrix.open("crop.rd.zarr")
    assert (crop.points, crop.window) == ((4, 3), (11, 9)) and np.isnan(crop.response[0, 0, :, :2]).all()
    full = acquire.Matrix.open("full.rd.zarr")
    assert full.info["lit_pitch_mm"] == [1.5, 1.0] and full.info["provenance"]["lab"] == "ours"
    assert acquire.factor("full.rd.zarr", terms=1).report["psnr_db"] > 40


def test_attributes_follow_the_page_s_schema(truth, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    schema = next(json.loads(code) for kind, code in blocks("matrix-format.md") if kind == "json")
    validator = jsonschema.Draft202012Validator(schema)
    response = windows()
    response[0, 0, 0, 0] = [-1, np.nan, 5]
    with pytest.warns(acquire.FindingWarning):
        acquire.write_matrix(tmp_path / "m.rd.zarr", response, pitch_mm=0.5)
    for path in (Path(truth), ROOT / "captures/truth.rd.zarr", tmp_path / "m.rd.zarr"):
        attributes = json.loads((path / "zarr.json").read_text())["attributes"]
        validator.validate(attributes)
    assert not validator.is_valid({"pitch_mm": "0.5"})
