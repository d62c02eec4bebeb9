"""The code of docs/rendering.md."""

import json
import re

import numpy as np
import pytest

import acquire
from conftest import ROOT
from test_package import page

MODELS = [dict(model="joint", terms=6, maps=True), dict(model="tucker", terms=4, degree=3), dict(model="peers2006", terms=3)]


@pytest.mark.parametrize("how", MODELS, ids=lambda how: how["model"])
def test_the_python_evaluator_is_the_material_s_response(truth, tmp_path, how):
    material = acquire.factor(truth, **how)
    material.export(tmp_path / "m.npz")
    names = {}
    for name, word in (("materials.md", "def row"), ("rendering.md", "def response")):
        code = next(block for block in page(name) if word in block)
        assert len(code.splitlines()) <= 31
        exec(compile(code, f"docs/{name}", "exec"), names)
    h, t = names["load"](tmp_path / "m.npz")
    lit = material.lit_mm
    # The lattice by least squares, as the library's.
    grid = np.stack([*np.meshgrid(np.arange(lit.shape[1]), np.arange(lit.shape[0])), np.ones(lit.shape[:2])], -1).reshape(-1, 3)
    to_mm = np.linalg.lstsq(grid, lit.reshape(-1, 2), rcond=None)[0]
    from_mm = lambda x: np.linalg.solve(to_mm[:2].T, np.asarray(x) - to_mm[2])  # noqa: E731
    rng = np.random.default_rng(4)
    for _ in range(40):
        x_i = grid[rng.integers(len(grid))] @ to_mm + rng.uniform(-0.2, 0.2, 2)
        x_o = x_i + rng.normal(0, 0.8, 2)
        np.testing.assert_allclose(names["response"](h, t, from_mm, x_i, x_o), material.response(x_i, x_o)[0], rtol=1e-4, atol=1e-6)


@pytest.fixture(scope="module")
def opengl():
    moderngl = pytest.importorskip("moderngl")
    try:
        return moderngl.create_context(standalone=True, backend="egl", require=330)
    except Exception as error:  # no driver, no library: each has its own class
        pytest.skip(f"no OpenGL: {error}")


# A picture whose pixels are the samples of a window.
ALL = "#version 330\nvoid main() { gl_Position = vec4(vec2(gl_VertexID % 2, gl_VertexID / 2) * 4 - 1, 0, 1); }"
SHADER = """#version 330
{code}
uniform int asked;
uniform vec2 lit_mm;
out vec4 found;
void main() {{
    ivec2 k = ivec2(gl_FragCoord.xy);
    found = vec4(response(asked, k, lit_mm + pitch_mm * vec2(k - window / 2)), 1);
}}
"""


@pytest.mark.parametrize("how", [MODELS[0], MODELS[2], dict(model="joint", terms=5, maps=False)], ids=lambda how: f"{how['model']}-{how.get('maps')}")
def test_the_glsl_evaluator_is_the_material_s_row(truth, opengl, how):
    material = acquire.factor(truth, **how)
    h, t = material.info, material.factors
    (code,) = page("rendering.md", "glsl")
    program = opengl.program(vertex_shader=ALL, fragment_shader=SHADER.format(code=code))
    rows, (w, n) = int(np.prod(h["points"])), h["window"]

    def give(unit, name, image, kind="f4"):
        image = np.ascontiguousarray(np.atleast_3d(image), kind.replace("i", "<i").replace("f", "<f"))
        opengl.texture((image.shape[1], image.shape[0]), image.shape[2], image.tobytes(), dtype=kind, alignment=1).use(unit)
        if name in program:
            program[name].value = unit

    profile = t["profile"][:, None] if "profile" in t else 1.0
    samples = np.moveaxis(t["offset_factors"] * profile, 1, -1)
    give(0, "F", (t["incident_factors"] * t["weights"]).reshape(-1, h["terms"]))
    give(1, "H", samples.reshape(-1, h["terms"]))
    give(2, "shift", t["shift"].reshape(-1, 1, 2), "i4")
    grid = h.get("exit_grid") or {"size": (0, 0), "origin_mm": (0.0, 0.0)}
    if h.get("exit_grid"):
        assert grid["planes"] == 3
        give(3, "entry", t["entry_map"])
        give(4, "exit_map", t["exit_map"].reshape(-1, grid["size"][0]))
    given = dict(terms=h["terms"], incident_planes=h["incident_planes"], offset_planes=h["offset_planes"], rows=rows, window=(w, n))
    given |= dict(extended=tuple(h["extended"]), exit_size=tuple(grid["size"]), exit_origin_mm=tuple(grid["origin_mm"]), pitch_mm=h["pitch_mm"])
    for name in set(given) & set(program):
        program[name].value = given[name]
    picture = opengl.framebuffer([opengl.texture((w, n), 4, dtype="f4")])
    picture.use()
    for index in (0, 37, 79):
        given = dict(asked=index, lit_mm=tuple(material.lit_mm.reshape(-1, 2)[index]))
        for name in set(given) & set(program):
            program[name].value = given[name]
        opengl.vertex_array(program, []).render(vertices=3)
        expected = material.row(index)
        found = np.frombuffer(picture.read(components=4, dtype="f4"), "<f4").reshape(n, w, 4)[..., :3]
        # f32 sums of f32 factors.
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=2e-6 * expected.max())


def bowl(path, n=12):
    """A paraboloid, 24 mm wide, seen from above and lengths nearly kept by its UVs, 40 mm a unit."""
    from test_mitsuba import mesh

    u, v = (w.ravel() for w in np.meshgrid(np.linspace(-12, 12, n), np.linspace(-12, 12, n)))
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([first, first + 1, first + n + 1], -1), np.stack([first, first + n + 1, first + n], -1)])
    mesh("bowl", np.stack([u, v, (u**2 + v**2) / 60], -1), np.stack([u, v], -1) / 40 + 0.5, faces).write_ply(path)


def test_the_mitsuba_page_s_code_runs(truth, tmp_path, monkeypatch):
    mi = pytest.importorskip("mitsuba")
    import acquire.mitsuba

    try:
        acquire.mitsuba.find_llvm()
    except acquire.InputError as missing:
        pytest.skip(str(missing))
    monkeypatch.chdir(tmp_path)
    acquire.factor(truth, terms=6).save("slab.safetensors")
    acquire.mitsuba.use()
    bowl("bowl.ply")
    names = {}
    for code in [block for block in page("rendering.md") if "acquire.mitsuba" in block]:
        exec(compile(code, "docs/rendering.md", "exec"), names)
    picture = np.array(names["picture"])
    assert picture.shape == (96, 96, 3) and np.isfinite(picture).all() and (tmp_path / "picture.png").exists()
    assert (tmp_path / "baked/exitance.exr").exists() and names["baked"].exitance.max() > 0
    # Every parameter that the page tells is one that the plug-ins ask for, and no other.
    told = set(re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/rendering.md").read_text(), re.M))
    code = "".join((ROOT / f"python/acquire/mitsuba/{name}.py").read_text() for name in ("_slab", "_integrator"))
    asked = re.findall(r'(?:props\.get\(|_number\(props, |props\[)"(\w+)"', code)
    assert told == set(asked) | {"mm_per_uv"}


def test_the_figures_are_made_by_one_command(truth, tmp_path, monkeypatch):
    for needed in ("mitsuba", "skimage", "xatlas", "flip_evaluator"):
        pytest.importorskip(needed)
    import acquire.mitsuba
    from acquire.figures.__main__ import main

    try:
        acquire.mitsuba.find_llvm()
    except acquire.InputError as missing:
        pytest.skip(str(missing))
    words = f"figures --out {tmp_path / 'figures'} --chessboard {truth} --chessboard4 {truth} --marble {truth} --width 48 --spp 8"
    monkeypatch.setattr("sys.argv", words.split())
    main()
    measured = json.loads((tmp_path / "figures/figure-2.json").read_text())["figure_2"]
    names = ["matrix, other seed", "Peers et al. 2006", "Kurt et al. 2013", "joint, with maps"]
    assert [m["name"] for m in measured] == names
    # With the matrix's own random numbers a model is nearer to its picture than the matrix with others.
    assert all(m["psnr_db"] > measured[0]["psnr_db"] and m["flip"] < measured[0]["flip"] for m in measured[1:])
    for name in ("figure-1.png", "figure-2.png", "figure-3.png"):
        assert (tmp_path / "figures" / name).stat().st_size > 10_000
    found = json.loads((tmp_path / "figures/figure-3.json").read_text())["figure_3"]
    by_name = {m["name"]: m for m in found["models"]}
    # More terms are more bytes and a nearer picture; coded is smaller and, its maps quantized, no nearer.
    eight, most, coded = (by_name[f"joint, T = {t}"] for t in ("8", "30", "30, coded"))
    assert eight["bytes"] < most["bytes"] and eight["psnr_db"] < most["psnr_db"]
    assert coded["bytes"] < most["bytes"] / 4 and coded["psnr_db"] < most["psnr_db"]
    for terms in (5, 10, 15, 20):
        of_tucker, of_peers = [m for m in found["models"] if m["series"] in ("tucker", "peers2006")][terms // 5 * 2 - 2 : terms // 5 * 2]
        assert of_tucker["terms"] == terms and of_peers["bytes"] <= of_tucker["bytes"]
    # With random numbers of its own a picture is further away, and the further the fewer its paths.
    errors = [t["psnr_db"] for t in found["times"]]
    assert errors == sorted(errors) and errors[-1] < by_name[found["timed"]]["psnr_db"]
    assert [t["spp"] for t in found["times"]] == [1, 2, 8]


def test_figure_3_has_each_model_where_its_bytes_and_decibels_are(tmp_path):
    image = pytest.importorskip("PIL.Image")
    from xml.etree import ElementTree

    from acquire.figures._trade import LOOKS, draw

    models = [{"series": s, "name": f"{s}, T = {t}", "terms": t, "bytes": 1000 * 4**k * (t + 1), "psnr_db": 40.0 + 3 * k + t} for k, s in enumerate(LOOKS) for t in (8, 15)]
    times = [{"spp": n, "processor_secs": 0.1 * n, "psnr_db": 20.0 + n} for n in (4, 16)]
    drawing = draw({"models": models, "timed": "joint, T = 15", "times": times})
    drawing.save_svg(tmp_path / "3.svg")
    drawing.save_png(tmp_path / "3.png")
    marks = [p for p in ElementTree.parse(tmp_path / "3.svg").iter() if p.tag.endswith("polygon")]
    middle = lambda p: np.array([[float(v) for v in xy.split(",")] for xy in p.get("points").split()]).mean(0)  # noqa: E731
    with image.open(tmp_path / "3.png") as opened:
        picture = np.asarray(opened.convert("RGB")).astype(int)
    assert picture.shape == (350, 760, 3)
    for series, (_, colour) in LOOKS.items():
        places = [middle(p) for p in marks if p.get("fill") == colour]
        # Two on the left, one in the legend; of the timed model two on the right.
        assert len(places) == (5 if series == "joint" else 3)
        few, many = [m for m in models if m["series"] == series]
        step = places[1] - places[0]
        # 404 px for the range of bytes and a fifth of it more; the PNG has the mark at the same place.
        assert step[0] == pytest.approx(np.log(many["bytes"] / few["bytes"]) / np.log(64 * 16 / 9) / 1.2 * 406, abs=1.0)
        assert step[1] < -30
        x, y = places[0].round().astype(int)
        assert (abs(picture[y, x] - [int(colour[k : k + 2], 16) for k in (1, 3, 5)]) < 8).all()
