"""Tasks of a cluster: the same matrix, whatever becomes of a worker."""

import os
import signal
import threading
import time
import warnings

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
    killed: list[int] = []

    def kill_one():
        # As soon as a part is being measured.
        while not list(tmp_path.glob("m.rd.zarr.parts/.*.part.*.unfinished")):
            time.sleep(0.001)
        pid = next(iter(cluster.run(os.getpid).values()))
        os.kill(pid, signal.SIGKILL)
        killed.append(pid)

    thread = threading.Thread(target=kill_one, daemon=True)
    thread.start()
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


def test_a_tradeoff_is_measured_by_tasks(cluster, truth):
    tried = [{"model": "joint", "terms": 1}, {"model": "joint", "terms": 6}, {"model": "tucker", "terms": 2, "degree": 3}]
    told = acquire.dask.tradeoff(truth, client=cluster, settings=tried)
    assert [one["settings"] for one in told] == tried
    assert told[1]["rel_rmse"] < told[0]["rel_rmse"] and told[1]["bytes"] > told[0]["bytes"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", acquire.FindingWarning)
        alone = acquire.factor(truth, **tried[2])
    assert told[2]["rel_rmse"] == acquire.evaluate(alone, truth)["rel_rmse"]
