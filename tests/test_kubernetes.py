"""The manifests of infra/kubernetes by the published schemas, by the operator's own, and beside each other."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest
import yaml

from schemas.config import RunConfig, load_config

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "infra" / "kubernetes"
MANIFESTS = [
    pytest.param(document, id=f"{path.stem}-{document['kind']}")
    for path in sorted(FOLDER.glob("*.yaml"))
    for document in yaml.safe_load_all(path.read_text())
]
VERSION = "1.30"


def named(kind: str) -> dict[str, Any]:
    [found] = [p.values[0] for p in MANIFESTS if p.values[0]["kind"] == kind]  # type: ignore[index]
    return dict(found)  # type: ignore[call-overload]


def pods(document: dict[str, Any]) -> list[dict[str, Any]]:
    """The pods that a manifest describes."""
    spec = document["spec"]
    if document["kind"] == "DaskCluster":
        return [spec["scheduler"]["spec"], spec["worker"]["spec"]]
    return [spec["template"]["spec"]] if "template" in spec else []


@pytest.mark.parametrize("document", MANIFESTS)
def test_manifests_hold_by_the_published_schemas(document: dict[str, Any]) -> None:
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is not installed.").validate
    if document["kind"] != "DaskCluster":
        validate(document, VERSION, strict=True)
        return
    service = {"apiVersion": "v1", "kind": "Service", "metadata": {"name": "s"}}
    validate(service | {"spec": document["spec"]["scheduler"]["service"]}, VERSION, strict=True)
    for spec in pods(document):
        validate({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "p"}, "spec": spec}, VERSION, strict=True)


def test_the_cluster_holds_by_the_operators_own_schema() -> None:
    found = importlib.util.find_spec("dask_kubernetes")
    if found is None or not found.submodule_search_locations:
        pytest.skip("dask-kubernetes is not installed: pip install dask-kubernetes.")
    jsonschema = pytest.importorskip("jsonschema")
    chart = Path(found.submodule_search_locations[0]) / "operator/deployment/helm/dask-kubernetes-operator/crds"
    definition = yaml.safe_load((chart / "daskcluster.yaml").read_text())
    [version] = [v for v in definition["spec"]["versions"] if v["name"] == "v1"]
    jsonschema.validate(named("DaskCluster"), version["schema"]["openAPIV3Schema"])


def test_the_manifests_belong_together() -> None:
    claim, image = named("PersistentVolumeClaim")["metadata"]["name"], set()
    cluster = named("DaskCluster")["metadata"]["name"]
    for parameters in MANIFESTS:
        for pod in pods(parameters.values[0]):  # type: ignore[arg-type]
            image |= {container["image"] for container in pod["containers"]}
            for volume in pod.get("volumes", []):
                assert volume["persistentVolumeClaim"]["claimName"] == claim
    assert len(image) == 1
    address = load_config(ROOT / "infra/dask/kubernetes.yaml", RunConfig).execution.dask_address
    assert address == f"tcp://{cluster}-scheduler:8786", "the operator names the service so"
    service = f"http://{named('Service')['metadata']['name']}:4200/api"
    [worker] = pods(named("DaskCluster"))[1]["containers"]
    [sweep] = pods(named("Job"))[0]["containers"]
    for container in (worker, sweep):
        assert {"name": "PREFECT_API_URL", "value": service} in container["env"]
    mounts = [container["volumeMounts"] for container in (worker, sweep)]
    assert mounts[0] == mounts[1], "the same path on all"
    assert (ROOT / sweep["command"][-1]).exists()
