"""The image, and what is deployed with it: what can be read of them, and where it is, what runs."""

from __future__ import annotations

import http.server
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from sightline.cli import COMMANDS

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
CONTAINERFILE = (ROOT / "Containerfile").read_text(encoding="utf-8")
BASE = "SIGHTLINE_TEST_BASE"
"""Names an image with Python and venv to build on, where none can be pulled."""


def instructions() -> list[tuple[str, str]]:
    """Instructions of the Containerfile, continued lines joined."""
    joined = re.sub(r"\\\n", " ", re.sub(r"^\s*#.*\n", "", CONTAINERFILE, flags=re.MULTILINE))
    lines = [line.strip() for line in joined.splitlines() if line.strip()]
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in lines]


def test_every_install_in_the_image_is_pinned() -> None:
    installs = [text for name, text in instructions() if name == "RUN" and "pip install" in text]
    assert [text.count("pip install") for text in installs] == [2, 1]
    assert all(
        text.count(" --constraint constraints.txt") == text.count("pip install")
        for text in installs
    )
    assert "--build-constraint constraints.txt" in installs[0]
    # The other is of a version that the constraints name.
    assert "s/^onnxruntime==//p" in installs[1]


def test_the_image_runs_as_nobody_and_says_how_it_is() -> None:
    stages = [text.split(" AS ") for name, text in instructions() if name == "FROM"]
    assert [stage for _, stage in stages] == ["build", "build-cuda", "common", "cuda", "cpu"]
    last = dict(instructions()[[text for _, text in instructions()].index("${BASE} AS common") :])
    assert last["USER"] == "10001:10001"
    assert last["STOPSIGNAL"] == "SIGTERM"
    assert "health.py" in last["HEALTHCHECK"]
    assert last["ENTRYPOINT"] == '["sightline"]'
    # No stage that is run becomes root again.
    assert [text for name, text in instructions() if name == "USER"] == ["10001:10001"]


def test_what_the_image_copies_is_let_in_and_nothing_else() -> None:
    kept = (ROOT / ".containerignore").read_text(encoding="utf-8").split()
    let_in = {line[1:] for line in kept if line.startswith("!")}
    copied = {
        word
        for name, text in instructions()
        if name == "COPY" and "--from" not in text
        for word in text.split()[:-1]
    }
    assert copied == let_in
    assert all((ROOT / one).exists() for one in copied)


def documents(name: str) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((DEPLOY / name).read_text(encoding="utf-8")))


@pytest.mark.parametrize("name", ["camera.compose.yaml", "fleet.compose.yaml"])
def test_services_may_do_nothing_that_they_need_not(name: str) -> None:
    (content,) = documents(name)
    for service in content["services"].values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert not service["user"].startswith("0")
        assert service["mem_limit"]
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", []))
        if service["image"] == "sightline":
            assert service["command"][0] in {command.__name__ for command in COMMANDS}
        for volume in service.get("volumes", []):
            source = volume.split(":")[0]
            # What is mounted is a file beside it, to be read, or a volume that is declared.
            assert source in content["volumes"] or volume.endswith(":ro")


def test_prometheus_and_the_cameras_of_a_fleet_name_each_other() -> None:
    (fleet,) = documents("fleet.compose.yaml")
    (prometheus,) = documents("prometheus.yml")
    (job,) = prometheus["scrape_configs"]
    cameras = [name for name, one in fleet["services"].items() if one["image"] == "sightline"]
    assert job["static_configs"][0]["targets"] == [f"{name}:8080" for name in cameras]


def containers(node: object) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Each container with the specification of its pod."""
    if isinstance(node, dict):
        for one in node.get("containers", []):
            yield one, node
        for value in node.values():
            yield from containers(value)
    elif isinstance(node, list):
        for value in node:
            yield from containers(value)


@pytest.mark.parametrize(("name", "count"), [("kubernetes.yaml", 1), ("kuberay.yaml", 2)])
def test_pods_keep_to_the_restricted_standard(name: str, count: int) -> None:
    """Pod Security Standards, restricted, and a root that is only read."""
    found = list(containers(documents(name)))
    assert len(found) == count
    for container, pod in found:
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["automountServiceAccountToken"] is False
        own = container["securityContext"]
        assert own["allowPrivilegeEscalation"] is False
        assert own["readOnlyRootFilesystem"] is True
        assert own["capabilities"] == {"drop": ["ALL"]}
        assert container["resources"]["limits"]["memory"]
        mounted = {one["name"] for one in container["volumeMounts"]}
        assert mounted == {one["name"] for one in pod["volumes"]}


class _Health(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        asked = self.path == "/healthz" and self.headers["Authorization"] == "Bearer hush"
        self.send_response(200 if asked else 503)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


def test_health_is_asked_with_the_token(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("hush\n")
    server = http.server.HTTPServer(("127.0.0.1", 0), _Health)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        asked = [sys.executable, str(DEPLOY / "health.py"), str(server.server_port)]
        clean = {name: one for name, one in os.environ.items() if "SIGHTLINE" not in name}
        for given, status in (
            ({"SIGHTLINE_TOKEN": "hush"}, 0),
            ({"SIGHTLINE_TOKEN_FILE": str(tmp_path / "token")}, 0),
            ({}, 1),
        ):
            done = subprocess.run(asked, env={**clean, **given}, check=False, capture_output=True)
            assert done.returncode == status
    finally:
        server.shutdown()
        server.server_close()
    done = subprocess.run(asked, check=False, capture_output=True)
    assert done.returncode == 1


def test_the_bill_of_materials_names_what_is_installed(tmp_path: Path) -> None:
    path = tmp_path / "sbom.cdx.json"
    asked = [sys.executable, str(ROOT / "tools" / "sbom.py"), str(path)]
    subprocess.run(asked, check=True)
    first = path.read_bytes()
    subprocess.run(asked, check=True)
    assert path.read_bytes() == first
    content = json.loads(first)
    assert (content["bomFormat"], content["specVersion"]) == ("CycloneDX", "1.5")
    named = {one["name"]: one for one in content["components"]}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {re.split(r"[<>=;\[ ]", line)[0] for line in project["dependencies"]}
    assert wanted <= named.keys()
    assert named["gpxpy"]["purl"].startswith("pkg:pypi/gpxpy@")
    refs = {one["bom-ref"] for one in content["components"]}
    assert all(set(one["dependsOn"]) <= refs for one in content["dependencies"])


def podman(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run an image as it is deployed, without network, as a sandbox allows it."""
    # Only with a mount namespace of its own may cgroups be mounted where they are not.
    script = 'mount -t cgroup2 none /sys/fs/cgroup 2>/dev/null; exec podman "$@"'
    return subprocess.run(
        ["unshare", "-m", "sh", "-c", script, "sh", *arguments],
        capture_output=True,
        text=True,
        check=False,
        **options,
    )


RUN = (
    *("run", "--rm", "--cgroups=disabled", "--network", "none", "--read-only"),
    *("--cap-drop", "ALL", "--security-opt", "no-new-privileges", "--tmpfs", "/tmp"),
    *("--ulimit", "nofile=1000:1000", "--ulimit", "nproc=1000:1000"),
)


@pytest.fixture(scope="module")
def image() -> str:
    for program in ("buildah", "podman", "unshare"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed, so no image is built and run")
    base = os.environ.get(BASE)
    if not base:
        pytest.skip(f"{BASE} names no image with Python and venv to build on")
    name = "localhost/sightline-test"
    more = os.environ.get("SIGHTLINE_TEST_BUILD", "").split()
    done = subprocess.run(
        [
            *("buildah", "bud", "--isolation", "chroot", "--format", "docker", *more),
            *("--build-arg", f"BASE={base}", "-t", name, str(ROOT)),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return name


@pytest.mark.slow
def test_the_image_runs_read_only_as_nobody(image: str) -> None:
    done = podman(*RUN, image, "--version")
    assert done.stdout.startswith("sightline "), done.stderr
    done = podman(*RUN, "--entrypoint", "python3", image, "-c", "import os; print(os.getuid())")
    assert done.stdout.strip() == "10001", done.stderr
    touch = "open('/opt/sightline/x', 'w')"
    done = podman(*RUN, "--entrypoint", "python3", image, "-c", touch)
    assert "Read-only file system" in done.stderr
    capabilities = "print([l for l in open('/proc/self/status') if l.startswith('CapEff')])"
    done = podman(*RUN, "--entrypoint", "python3", image, "-c", capabilities)
    assert "0000000000000000" in done.stdout, done.stderr


@pytest.mark.slow
def test_live_in_the_image_is_healthy_and_ends_in_order(image: str) -> None:
    script = """
    sightline simulate -o /tmp/h --recordings 1 --duration 20 > /tmp/log
    sightline run /tmp/h/scene.toml -o /tmp/r > /tmp/log 2>&1
    sightline live /tmp/h/01.mp4 --as-live --model /tmp/r/model.safetensors \\
        --serve 127.0.0.1:8080 --store /tmp/d.db &
    pid=$!
    for i in $(seq 60); do
        sleep 0.5
        python3 /usr/local/lib/sightline/health.py 2> /tmp/log && echo healthy && break
    done
    kill -TERM $pid
    wait $pid
    echo status $?
    """
    done = podman(*RUN, "--entrypoint", "sh", image, "-c", script)
    assert "healthy" in done.stdout, done.stderr
    assert "status 0" in done.stdout, done.stderr


@pytest.mark.slow
def test_the_image_tracks_and_is_no_larger_than_said(image: str) -> None:
    asked = "simulate -o /tmp/h --no-video --recordings 2 --duration 20"
    line = f"sightline {asked} && sightline run /tmp/h/scene.toml -o /tmp/r && ls /tmp/r"
    done = podman(*RUN, "--entrypoint", "sh", image, "-c", line)
    assert "model.safetensors" in done.stdout, done.stderr
    done = podman("image", "inspect", "--format", "{{.Size}}", image)
    assert int(done.stdout) < 1_000_000_000
