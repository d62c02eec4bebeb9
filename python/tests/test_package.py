"""What comes with the module, and the code of the documentation."""

import inspect
import re
import runpy
import sys

import numpy as np
import pytest

import acquire
from conftest import ROOT


def test_types_and_texts_are_there():
    package = ROOT / "python/acquire"
    assert (package / "py.typed").exists() and (package / "_acquire.pyi").exists()
    for name in acquire.__all__:
        thing = getattr(acquire, name)
        assert inspect.getdoc(thing) or isinstance(thing, (str, bool)), name
        if inspect.isclass(thing):
            for method, member in vars(thing).items():
                if not method.startswith("_") and callable(getattr(thing, method)):
                    assert inspect.getdoc(member), f"{name}.{method}"
    assert re.fullmatch(r"\d+\.\d+\.\d+", acquire.__version__)


@pytest.mark.parametrize("example", sorted((ROOT / "python/examples").glob("*.py")), ids=lambda p: p.name)
def test_examples_run(example, tmp_path, monkeypatch):
    if "xarray" in example.read_text():
        pytest.importorskip("xarray")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example)])
    runpy.run_path(str(example), run_name="__main__")


def page(name, language="python"):
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "docs" / name).read_text(), re.S)


@pytest.mark.parametrize(
    "how",
    [
        dict(model="joint", terms=6, maps=True),
        dict(model="joint", terms=3, maps=False),
        dict(model="tucker", terms=4, degree=3),
        dict(model="peers2006", terms=3),
        dict(model="joint", terms=8, precision="f16", maps=True),
    ],
    ids=lambda how: "-".join(str(v) for v in how.values()),
)
@pytest.mark.parametrize("kind", ["npz", "safetensors"])
def test_the_numpy_of_the_materials_page_evaluates_any_material(truth, tmp_path, how, kind):
    code = next(block for block in page("materials.md") if "def row" in block)
    assert len(code.splitlines()) <= 25
    names = {}
    if kind == "safetensors":
        pytest.importorskip("safetensors")
    exec(compile(code, "docs/materials.md", "exec"), names)
    material = acquire.factor(truth, **how)
    if kind == "npz":
        material.export(tmp_path / "m.npz")
    else:
        material.save(tmp_path / "m.safetensors")
    loaded = names["load"](tmp_path / f"m.{kind}")
    for i in (0, 7, 45, 79):
        expected = material.row(i)
        # f32 sums in NumPy.
        np.testing.assert_allclose(names["row"](*loaded, i), expected, rtol=1e-4, atol=1e-5 * expected.max())


@pytest.mark.parametrize("how", [dict(model="joint", terms=6, maps=True), dict(model="tucker", terms=4, degree=3), dict(model="peers2006", terms=3)], ids=lambda h: h["model"])
def test_the_exr_reader_of_the_materials_page_gives_rows_and_where_they_lie(truth, tmp_path, how):
    pytest.importorskip("OpenEXR")
    names = {}
    exec(compile(next(block for block in page("materials.md") if "OpenEXR" in block), "docs/materials.md", "exec"), names)
    material = acquire.factor(truth, **how)
    material.export(tmp_path / "m.exr")
    parts = names["load"](tmp_path / "m.exr")
    pitch, (w, h), (columns, _) = material.info["pitch_mm"], material.info["window"], material.info["points"]
    for i in (0, 7, 45, 79):
        dx, dy, found = names["row"](parts, i % columns, i // columns)
        on_window = np.zeros((h, w, 3))
        k, j = (np.rint(d / pitch).astype(int) + n // 2 for d, n in ((dx, w), (dy, h)))
        inside = [(0 <= at) & (at < n) for at, n in ((j, h), (k, w))]
        on_window[np.ix_(j[inside[0]], k[inside[1]])] = found[np.ix_(*inside)]
        expected = material.row(i)
        # f32 maps, and colours by powers of an intensity, which cancel: 3e-7 of the peak measured.
        np.testing.assert_allclose(on_window, expected, atol=1e-5 * expected.max())


def test_the_python_page_s_code_runs(tmp_path, monkeypatch, truth):
    monkeypatch.chdir(tmp_path)
    names = {}
    for code in page("python.md"):
        exec(compile(code, "docs/python.md", "exec"), names)
