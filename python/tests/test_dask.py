"""Tasks of a cluster: the same matrix, whatever becomes of a worker."""

import os
import signal
import threading
import time
import warnings

import numpy as np
import pytest

import acquire

distributed = pytest.importorskip("distributed")
import acquire.dask


@pytest.fixture(scope="module")
def cluster():
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**options, silence_logs=50) as local, distributed.Client(local) as client:
        yield client


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture without a chessboard, which is built without OpenCV, and its matrix as one process builds it."""
    folder = tmp_path_factory.mktemp("capture")
    acquire.simulate(folder / "c", grid=(8, 6), window=(9, 7), exposures=2, seed=3, voxels_per_sample=1, frame_marks=True, without_board=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", acquire.FindingWarning)
        acquire.build_matrix(folder / "c", folder / "whole.rd.zarr")
    return folder


def files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.filterwarnings("ignore::acquire.FindingWarning")
def test_the_matrix_of_a_cluster_is_that_of_one_process_though_a_worker_is_killed(cluster, capture, tmp_path):
    out = tmp_path / "m.rd.zarr"
    # As soon as a part is being measured.
    thread, killed = kill_one_when(cluster, lambda: list(tmp_path.glob("m.rd.zarr.parts/.*.part.*.unfinished")))
    report = acquire.dask.build_matrix(capture / "c", out, client=cluster, parts=6)
    thread.join(10)
    assert killed and report["lattice_shots"] > 6 and report["unused_parts"] in ([], ["1 unfinished (of tasks that still run, or were killed)"])
    assert files(out) == files(capture / "whole.rd.zarr")
    assert list(tmp_path.iterdir()) == [out], "parts are removed"


@pytest.mark.filterwarnings("ignore::acquire.FindingWarning")
def test_an_error_of_a_task_is_the_caller_s_and_what_was_measured_is_used_again(cluster, capture, tmp_path):
    manifest = (capture / "c/capture.toml").read_text()
    name = max(p.name for p in (capture / "c").rglob("lattice-*"))
    photograph = next((capture / "c").rglob(name))
    kept = photograph.read_bytes()
    photograph.unlink()
    with pytest.raises(acquire.InputError, match=name):
        acquire.dask.build_matrix(capture / "c", tmp_path / "m.rd.zarr", client=cluster, parts=3, retries=0)
    photograph.write_bytes(kept)
    assert (capture / "c/capture.toml").read_text() == manifest
    acquire.dask.build_matrix(capture / "c", tmp_path / "m.rd.zarr", client=cluster, parts=3)
    assert files(tmp_path / "m.rd.zarr") == files(capture / "whole.rd.zarr")
    with pytest.raises(acquire.InputError, match="force=True"):
        acquire.dask.build_matrix(capture / "c", tmp_path / "m.rd.zarr", client=cluster)
    for parts in (0, 1000):
        with pytest.raises(acquire.InputError, match=f"the number of lattice shots, found {parts}"):
            acquire.dask.build_matrix(capture / "c", tmp_path / "n.rd.zarr", client=cluster, parts=parts)


def kill_one_when(cluster, seen):
    """Kills a worker as soon as ``seen()``; a list that has its process then."""
    killed: list[int] = []

    def kill():
        while not seen():
            time.sleep(0.0005)
        pid = next(iter(cluster.run(os.getpid).values()))
        os.kill(pid, signal.SIGKILL)
        killed.append(pid)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    return thread, killed


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """A matrix that is not square, not grey, has gaps, and rows whose peak is beside the lit point."""
    x, y, w, h = 17, 24, 15, 11
    dy, dx = np.mgrid[0:h, 0:w] - np.array([h // 2, w // 2])[:, None, None]
    i = np.arange(x * y).reshape(y, x, 1, 1, 1)
    shift = (i % 7 == 3).astype(float)
    reach = 2 + 0.5 * np.arange(3)
    fall = np.exp(-np.hypot(dx[None, None, :, :, None] - shift, dy[None, None, :, :, None]) / (reach * (1 + 0.3 * np.sin(0.2 * i))))
    response = (0.05 * fall * (1 + 0.5 * np.cos(0.37 * i + np.arange(3)))).astype(np.float32)
    valid = np.random.default_rng(2).random(response.shape) > 0.02
    path = tmp_path_factory.mktemp("drifting") / "m.rd.zarr"
    acquire.write_matrix(path, response, pitch_mm=0.25, variance=np.full_like(response, 1e-9), valid=valid, progress=False)
    return path


FACTORED = [{"model": "tucker", "terms": 5, "degree": 4}, {"model": "joint", "terms": 5, "maps": True}, {"model": "joint"}]


@pytest.mark.filterwarnings("ignore::acquire.FindingWarning")
@pytest.mark.parametrize("options", FACTORED, ids=["tucker", "joint-maps", "joint-by-noise"])
def test_one_material_of_a_cluster_is_that_of_one_process(cluster, drifting, tmp_path, options):
    alone = acquire.factor(drifting, backend="gram", progress=False, **options)
    made = acquire.dask.factor(drifting, tmp_path / "m.safetensors", client=cluster, blocks=5, backend="gram", **options)
    rows = np.arange(17 * 24)
    expected, found = alone.rows(rows), made.rows(rows)
    # Sums in f64 in another order; what is stored is f32.
    assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
    # After it come passes and residuals, which rounding may change.
    assert made.report["choice"].split("; gram")[0] == alone.report["choice"].split("; gram")[0]
    assert ", by tasks" in made.report["choice"]
    # By default products are in f32, of fewer rows at a time: an iteration ends elsewhere within its accuracy.
    default = acquire.dask.factor(drifting, tmp_path / "d.safetensors", client=cluster, blocks=5, **options)
    alone = acquire.factor(drifting, backend="randomized", progress=False, **options)
    assert default.report["rel_rmse"] == pytest.approx(alone.report["rel_rmse"], rel=1e-3)
    assert np.abs(default.rows(rows) - alone.rows(rows)).max() < 1e-3 * np.abs(expected).max()
    (tmp_path / "d.safetensors").unlink()
    assert acquire.Material.load(tmp_path / "m.safetensors").to_bytes() == made.to_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["m.safetensors"], "passes are removed"


@pytest.mark.filterwarnings("ignore::acquire.FindingWarning")
def test_a_worker_that_is_killed_while_factoring_changes_no_bit_of_the_material(cluster, drifting, tmp_path):
    options = {"model": "tucker", "terms": 5, "degree": 4, "blocks": 6, "client": cluster}
    acquire.dask.factor(drifting, tmp_path / "plain.safetensors", **options)
    folder = tmp_path / "passes"

    def half_way():
        # One part of the fourth pass is done, others are not.
        third = folder / "0003.sum"
        return third.exists() and any(part.stat().st_mtime_ns > third.stat().st_mtime_ns for part in folder.glob("*.part"))

    thread, killed = kill_one_when(cluster, half_way)
    acquire.dask.factor(drifting, tmp_path / "troubled.safetensors", folder=folder, **options)
    thread.join(10)
    assert killed
    assert (tmp_path / "troubled.safetensors").read_bytes() == (tmp_path / "plain.safetensors").read_bytes()


@pytest.mark.filterwarnings("ignore::acquire.FindingWarning")
def test_what_tasks_cannot_factor_is_refused_before_any_work(cluster, drifting, tmp_path):
    out = tmp_path / "m.safetensors"
    for wrong, words in ({"backend": "full"}, "backend: "), ({"memory": "1GiB"}, "memory: "), ({"blocks": 25}, "1 to 24, the chunks"), ({"terms": 0}, "terms: "):
        with pytest.raises(acquire.InputError, match=words):
            acquire.dask.factor(drifting, out, client=cluster, **wrong)
    out.write_text("a letter")
    with pytest.raises(acquire.InputError):
        acquire.dask.factor(drifting, out, client=cluster, terms=2, force=True)
    assert out.read_text() == "a letter"


def test_a_tradeoff_is_measured_by_tasks(cluster, truth):
    tried = [{"model": "joint", "terms": 1}, {"model": "joint", "terms": 6}, {"model": "tucker", "terms": 2, "degree": 3}]
    told = acquire.dask.tradeoff(truth, client=cluster, settings=tried)
    assert [one["settings"] for one in told] == tried
    assert told[1]["rel_rmse"] < told[0]["rel_rmse"] and told[1]["bytes"] > told[0]["bytes"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", acquire.FindingWarning)
        alone = acquire.factor(truth, **tried[2])
    assert told[2]["rel_rmse"] == acquire.evaluate(alone, truth)["rel_rmse"]
