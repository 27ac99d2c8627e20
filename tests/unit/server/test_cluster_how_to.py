"""What the how-to on clusters tells to run: the SLURM script that its program makes, and the Kubernetes manifest."""

from __future__ import annotations

import ast
import importlib.util
import re
import warnings
from typing import Any

import yaml

from stereorig.server.config.rig_file import ComputeSection
from tests.support.requirements import ROOT, missing

PAGE = (ROOT / "docs" / "how_to" / "scale_on_dask.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    found = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    assert len(found) == 1
    return str(found[0])


def test_the_slurm_program_asks_for_one_core_a_worker_and_ends_workers_in_time() -> None:
    if importlib.util.find_spec("dask_jobqueue") is None:
        missing("dask_jobqueue (pip install dask-jobqueue)")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its own, on import and at its end
        import dask_jobqueue

        made = next(node for node in ast.walk(ast.parse(block("python"))) if isinstance(node, ast.Call))
        assert isinstance(made.func, ast.Name)
        assert made.func.id == "SLURMCluster"
        options: dict[str, Any] = {str(k.arg): ast.literal_eval(k.value) for k in made.keywords}
        assert options["scheduler_options"]["port"] == 8786
        options["scheduler_options"]["port"] = 0  # another cluster may run here
        with dask_jobqueue.SLURMCluster(**options) as cluster:
            script = cluster.job_script()
    lines = script.splitlines()
    assert {"#SBATCH -n 1", "#SBATCH --cpus-per-task=1", "#SBATCH -t 02:00:00", "#SBATCH -p short"} <= set(lines)
    assert lines.index("export NUMBA_NUM_THREADS=1") < len(lines) - 1
    command = next(line for line in lines if "dask_worker" in line)
    assert command.startswith("/shared/stereorig/bin/python -m distributed.cli.dask_worker tcp://")
    for part in ("--nthreads 1 ", "--local-directory $TMPDIR", "--lifetime 110m", "--lifetime-stagger 5m"):
        assert part in command
    assert 110 + 5 < 120  # min: before SLURM's own end


def test_the_manifest_names_one_cluster_and_as_many_workers_as_the_rig_file_asks_for() -> None:
    cluster, scaler = yaml.safe_load_all(block("yaml"))
    assert (cluster["kind"], scaler["kind"]) == ("DaskCluster", "DaskAutoscaler")
    name = cluster["metadata"]["name"]
    assert scaler["spec"]["cluster"] == name
    service = cluster["spec"]["scheduler"]["service"]
    assert service["selector"]["dask.org/cluster-name"] == name
    ports = {port["name"] for port in cluster["spec"]["scheduler"]["spec"]["containers"][0]["ports"]}
    assert ports == {port["targetPort"] for port in service["ports"]}
    worker = cluster["spec"]["worker"]["spec"]
    mounted = {mount["name"] for mount in worker["containers"][0]["volumeMounts"]}
    assert mounted == {volume["name"] for volume in worker["volumes"]}
    args = worker["containers"][0]["args"]
    assert args[args.index("--nthreads") + 1] == "1"
    asked = re.search(r"tasks_at_once = (\d+)", PAGE)
    assert asked is not None
    compute = ComputeSection(scheduler=f"tcp://{name}-scheduler:8786", tasks_at_once=int(asked[1]))
    assert compute.tasks_at_once == scaler["spec"]["maximum"]
