"""What is also a command of the program: the results are the program's."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import warnings

import numpy as np
import pytest

import acquire
from conftest import windows


def full_matrix(nx=6, ny=5):
    """A full matrix over a lattice: it falls with the distance, and is not symmetric."""
    p = np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), -1).reshape(-1, 2)
    apart = np.linalg.norm(p[:, None] - p[None], axis=-1)
    return (0.1 * np.exp(-2 * apart) * (1 + 0.01 * np.arange(nx * ny)[:, None])).astype(np.float32)


def test_what_is_written_is_read(tmp_path):
    response = windows()
    response[0, 0, 0, 0] = np.nan
    response[2, 3, 4, 6, 1] = -0.01
    variance = np.full_like(response, 1e-8)
    y, x = np.mgrid[0:3, 0:4].astype(float)
    with pytest.warns(acquire.FindingWarning, match="negative-responses") as told:
        report = acquire.write_matrix(
            tmp_path / "m.rd.zarr", response, pitch_mm=0.25, variance=variance, x_i_mm=1.5 * x, y_i_mm=y, position_sd_mm=0 * x + 0.01
        )
    finding = told[0].message.finding
    assert finding["figures"] == {"entries": 1, "share": pytest.approx(0.01 / np.nansum(response), rel=0.01), "lowest": pytest.approx(-0.01), "at": "response[2, 3, 4, 6, 1]"}
    assert [f["id"] for f in report["findings"]] == ["negative-responses", "unmeasured-samples"]
    assert report["lit_pitch_mm"] == [1.5, 1.0] and report["channels"] == 3 and report["defaults"] == []
    matrix = acquire.Matrix.open(tmp_path / "m.rd.zarr")
    np.testing.assert_array_equal(matrix.response, response)
    np.testing.assert_array_equal(matrix.lit_mm, np.stack([1.5 * x, y], -1))
    assert len(matrix) == 12 and "4 × 3 points" in repr(matrix)
    with pytest.raises(acquire.InputError, match="force=True"):
        acquire.write_matrix(tmp_path / "m.rd.zarr", windows(), pitch_mm=0.25)
    acquire.write_matrix(tmp_path / "m.rd.zarr", windows(channels=1), pitch_mm=0.25, force=True)
    assert acquire.Matrix.open(tmp_path / "m.rd.zarr").read().valid.all()
    (tmp_path / "m.rd.zarr" / "notes.txt").write_text("keep")
    with pytest.raises(acquire.InputError, match="notes.txt: not replaced"):
        acquire.write_matrix(tmp_path / "m.rd.zarr", windows(), pitch_mm=0.25, force=True)
    with pytest.raises(acquire.InputError, match="apart from the inputs"):
        acquire.import_matrix(tmp_path / "m.rd.zarr", tmp_path, force=True)
    assert (tmp_path / "m.rd.zarr" / "notes.txt").read_text() == "keep"


def test_arrays_that_do_not_fit_are_refused_with_the_place(tmp_path):
    def refused(*args, **more):
        with pytest.raises(acquire.InputError) as raised:
            acquire.write_matrix(tmp_path / "m.rd.zarr", *args, **{"pitch_mm": 0.5, **more})
        assert not (tmp_path / "m.rd.zarr").exists() and not list(tmp_path.iterdir())
        return str(raised.value)

    response = windows()
    response[1, 2, 3, 4, 0] = np.inf
    assert "found inf at response[1, 2, 3, 4, 0]" in refused(response)
    assert "variance: expected the shape of response" in refused(windows(), variance=windows()[:1])
    assert "found -1 at variance[0, 0, 0, 0, 0]" in refused(windows(), variance=windows() * 0 - 1)
    assert "x_i_mm: expected shape [3, 4]" in refused(windows(), x_i_mm=np.zeros((4, 3)), y_i_mm=np.zeros((3, 4)))
    assert "odd numbers of samples" in refused(windows(window=(6, 5)))
    assert "pitch_mm: expected" in refused(windows(), pitch_mm=-1)
    assert "found shape [3]" in refused(np.zeros(3))
    assert "lit_pitch_mm: expected a number, or two" in refused(windows(), lit_pitch_mm=(1, 2, 3))


def test_a_full_matrix_is_imported_as_by_the_program(tmp_path, program):
    full = full_matrix()
    np.save(tmp_path / "full.npy", full)
    status, out, said = program("import-matrix", tmp_path / "full.npy", "--pitch-mm", 0.5, "--points", "6x5", "--window", "5x3", "--out", tmp_path / "a.rd.zarr", "--json")
    assert status == 0, said
    with pytest.warns(acquire.FindingWarning, match="light-outside-window"):
        report = acquire.write_matrix(tmp_path / "b.rd.zarr", full, pitch_mm=0.5, points=(6, 5), window=(5, 3))
    theirs = json.loads(out)
    assert {k: v for k, v in theirs.items() if k != "matrix"} == report
    a, b = (acquire.Matrix.open(tmp_path / f"{n}.rd.zarr").response for n in "ab")
    np.testing.assert_array_equal(a, b)
    # Against NumPy: R[i, o] at the offset of o from i, and the light that no window has.
    inside = 0
    for i in range(30):
        for o in range(30):
            dx, dy = o % 6 - i % 6, o // 6 - i // 6
            if abs(dx) <= 2 and abs(dy) <= 1:
                assert (a[i // 6, i % 6, dy + 1, dx + 2] == full[i, o]).all()
                inside += full[i, o].astype(float)
    assert report["light_outside_window"] == pytest.approx(1 - inside / full.sum(dtype=float), abs=1e-12)
    four = acquire.write_matrix(tmp_path / "c.rd.zarr", full.reshape(5, 6, 5, 6), pitch_mm=0.5, full=True)
    assert four["light_outside_window"] <= 1e-3


def test_files_are_imported(tmp_path):
    np.savez(tmp_path / "m.npz", response=windows(), pitch_mm=0.5, lit_pitch_mm=[1.5, 1.0])
    report = acquire.import_matrix(tmp_path / "m.npz", tmp_path / "m.rd.zarr")
    assert report["lit_pitch_mm"] == [1.5, 1.0]
    np.savez_compressed(tmp_path / "f.npz", response=np.asfortranarray(windows().astype(">f8")), pitch_mm=np.float32(0.5), valid=windows() > 0)
    acquire.import_matrix(tmp_path / "f.npz", tmp_path / "f.rd.zarr")
    a, b = (acquire.Matrix.open(tmp_path / n).response for n in ("m.rd.zarr", "f.rd.zarr"))
    np.testing.assert_array_equal(a, b)
    with pytest.raises(acquire.InputError, match="response: expected an array of this name"):
        np.savez(tmp_path / "e.npz", R=windows())
        acquire.import_matrix(tmp_path / "e.npz", tmp_path / "e.rd.zarr", pitch_mm=1)


def test_factor_and_evaluate_are_those_of_the_program(truth, tmp_path, program):
    material = acquire.factor(truth, terms=5, model="joint")
    status, _, said = program("factor", truth, "--terms", 5, "--model", "joint", "--out", tmp_path / "m.safetensors")
    assert status == 0, said
    theirs = acquire.Material.load(tmp_path / "m.safetensors")
    for name, values in material.factors.items():
        # f32, sums in another order.
        np.testing.assert_allclose(values, theirs.factors[name], rtol=1e-4, atol=1e-5 * np.abs(values).max(), err_msg=name)
    assert material.report["rel_rmse"] == pytest.approx(float(said.split("rel_rmse ")[1].split(",")[0]), abs=1e-5)
    measures = acquire.evaluate(material, truth)
    status, out, _ = program("evaluate", tmp_path / "m.safetensors", truth, "--json", "-q")
    for name, value in json.loads(out).items():
        # Places are f32 in files: 1e-7 of some millimetres, of 12 px each.
        assert measures[name] == (None if value is None else pytest.approx(value, rel=1e-3, abs=1e-5)), name
    assert acquire.evaluate(acquire.Matrix.open(truth), truth)["rel_rmse"] == 0
    assert acquire.evaluate(tmp_path / "m.safetensors", truth).keys() == measures.keys()


def test_options_are_those_of_the_program(truth):
    assert acquire.factor(truth, max_bytes="20kB").bytes_f32 <= 20_000
    assert acquire.factor(truth, target_psnr=40, precision="coded").report["precision"] == "coded"
    assert acquire.factor(truth, model="tucker", terms=2, degree=3, no_peak_shift=True).info["degree"] == 3
    assert acquire.factor(truth, terms=2, maps=False).info.get("exit_grid") is None
    assert acquire.factor(truth, terms=2, maps=True).info["exit_grid"]
    for wrong, words in ((dict(turms=3), "--turms"), (dict(model="svd"), "--model"), (dict(terms=0), "terms"), (dict(degree=77), "degree")):
        with pytest.raises(acquire.InputError, match=words):
            acquire.factor(truth, **wrong)


def test_a_target_that_is_missed_is_a_warning_with_its_finding(truth):
    with pytest.warns(acquire.FindingWarning, match="goal-missed") as told:
        material = acquire.factor(truth, max_bytes=50)
    told = next(w for w in told if w.message.finding["id"] == "goal-missed")
    assert told.filename == __file__
    finding = next(f for f in material.report["findings"] if f["id"] == "goal-missed")
    assert finding == told.message.finding and finding["figures"]["asked"] == "50 bytes"


def test_a_capture_is_simulated_and_built(tmp_path):
    report = acquire.simulate(tmp_path / "c", grid=(8, 6), window=(9, 9), exposures=3, frame_marks=True, without_board=True, seed=2)
    assert report["photographs"] > 10
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", acquire.FindingWarning)
        built = acquire.build_matrix(tmp_path / "c", tmp_path / "m.rd.zarr")
    assert {"camera_rms_px", "findings"} <= built.keys()
    measures = acquire.evaluate(tmp_path / "m.rd.zarr", tmp_path / "c/truth.rd.zarr")
    assert measures["rel_rmse"] < 0.05  # of 3 exposures and 12 points, twice what is usual
    with pytest.raises(acquire.InputError, match="no capture.toml"):
        acquire.build_matrix(tmp_path / "c/photos", tmp_path / "n.rd.zarr")
    if not acquire.has_opencv:
        acquire.simulate(tmp_path / "b", grid=2, window=5, exposures=2)
        with pytest.raises(acquire.InputError, match="built without"):
            acquire.build_matrix(tmp_path / "b", tmp_path / "n.rd.zarr")


def test_progress_is_told_and_what_it_raises_stops_the_work(tmp_path):
    stages = []
    acquire.simulate(tmp_path / "c", grid=64, window=9, truth_only=True, progress=lambda *step: stages.append(step))
    assert stages
    assert all(done <= total for _, done, total in stages)

    def stop(*step):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        acquire.simulate(tmp_path / "d", grid=60, window=5, progress=stop)
    assert not (tmp_path / "d").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c"], "nothing unfinished is left"


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_ctrl_c_stops_and_leaves_nothing(tmp_path):
    code = textwrap.dedent(
        """
        import acquire, sys
        def tell(*step):
            print("running", flush=True)
        try:
            acquire.simulate(sys.argv[1], grid=60, window=5, progress=tell)
        except KeyboardInterrupt:
            sys.exit(42)
        """
    )
    # Shells start what they put into the background with the signal ignored, and Python then leaves it so.
    heeded = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    child = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "c")], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heeded)
    assert child.stdout.readline() == "running\n"
    child.send_signal(signal.SIGINT)
    _, said = child.communicate(timeout=60)
    assert child.returncode == 42, said
    assert "panicked" not in said and not list(tmp_path.iterdir())


def test_the_interpreter_goes_on_while_a_call_works(tmp_path):
    import threading

    ticks, done = [], threading.Event()

    def count():
        while not done.wait(0.01):
            ticks.append(1)

    thread = threading.Thread(target=count)
    thread.start()
    try:
        acquire.simulate(tmp_path / "c", grid=12, window=5, truth_only=True, progress=False)
    finally:
        done.set()
        thread.join()
    assert len(ticks) > 3, "the lock was held"
