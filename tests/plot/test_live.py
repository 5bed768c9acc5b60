"""The live viewer: what its server is given is the model. A server that notes it stands for the real one, which is optional."""

import sys
import urllib.request
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import small_model
import torch
from command_line import assert_one_line, torchsfm

from torchsfm.cli import view
from torchsfm.geometry.rotations import rotation_from_quaternion_wxyz
from torchsfm.images import save_image
from torchsfm.plot import LiveViewer
from torchsfm.reconstruction import Lines, Reconstruction, up_direction


class Server:
    """What viser's server does here: it notes what there is, by name, until that is removed."""

    def __init__(self, **options: Any) -> None:
        self.options, self.shown, self.running = options, dict[str, SimpleNamespace](), True
        self.scene, self.initial_camera = self, SimpleNamespace()

    def __getattr__(self, kind: str) -> Any:
        if not kind.startswith("add_"):
            raise AttributeError(kind)

        def add(name: str, *values: Any, **options: Any) -> SimpleNamespace:
            assert name not in self.shown
            self.shown[name] = SimpleNamespace(kind=kind, values=values, remove=lambda: self.shown.pop(name), **options)
            return self.shown[name]

        return add

    def set_up_direction(self, direction: tuple[float, ...]) -> None:
        self.up = direction

    def get_host(self) -> str:
        return str(self.options["host"])

    def get_port(self) -> int:
        return int(self.options["port"])

    def stop(self) -> None:
        self.running = False


@pytest.fixture
def servers(monkeypatch: pytest.MonkeyPatch) -> list[Server]:
    """Those that were started."""
    started: list[Server] = []
    module = SimpleNamespace(ViserServer=lambda **options: started.append(Server(**options)) or started[-1])
    monkeypatch.setitem(sys.modules, "viser", module)
    return started


def test_the_server_is_given_the_model(servers: list[Server], tmp_path: Path) -> None:
    model = small_model.with_curves(small_model.make("pinhole"))
    none = torch.zeros(0, dtype=torch.long)
    lines = Lines(model.X[:8].reshape(4, 2, 3), model.color[:4], model.x.new_zeros(0, 2, 2), model.x.new_zeros(0), none, none)
    model = replace(model, lines=lines)
    save_image(tmp_path / "a.jpg", torch.ones(3, 600, 800))
    viewer = LiveViewer(port=8123)
    (server,) = servers
    assert viewer.address == "http://127.0.0.1:8123", "programs of other machines do not reach it"
    viewer.show(model, images=tmp_path)
    shown = server.shown
    assert set(shown) == {"/points", "/lines", "/curves", "/cameras/0", "/cameras/1", "/cameras/2"}
    assert np.array_equal(shown["/points"].values[0], model.X.float().numpy())
    assert np.abs(shown["/points"].values[1] / 255 - model.color.numpy()).max() <= 0.5 / 255 + 1e-6
    assert np.array_equal(shown["/lines"].values[0], lines.ends.float().numpy())
    assert shown["/lines"].values[1].shape == (4, 2, 3)
    assert model.curves is not None
    assert len(shown["/curves"].values[0]) == len(model.curves.links())
    assert shown["/cameras/0"].image.shape == (240, 320, 3)
    assert shown["/cameras/1"].image is None
    # A frustum looks along z, x to the right and y down; it is so many radians high, and so many times as wide as high.
    projections = model.projections()
    for row in range(len(model.x)):
        frustum = shown[f"/cameras/{int(model.view[row])}"]
        R = rotation_from_quaternion_wxyz(torch.from_numpy(frustum.wxyz))
        x, y, z = R.mT @ (model.X[model.point[row]] - torch.from_numpy(frustum.position))
        high = 2 * np.tan(frustum.values[0] / 2)
        u, v = float(x / z) / (high * frustum.values[1]), float(y / z) / high
        assert [800 * (u + 0.5) - 0.5, 600 * (v + 0.5) - 0.5] == pytest.approx(projections[row].tolist(), abs=1e-6)
    # One begins with all of it in sight, upright.
    up, start = torch.tensor(server.up, dtype=torch.float64), server.initial_camera
    torch.testing.assert_close(up, up_direction(model))
    eye, middle = torch.tensor(start.position, dtype=torch.float64), torch.tensor(start.look_at, dtype=torch.float64)
    towards = (middle - eye) / (middle - eye).norm()
    assert bool(((model.X - eye) @ towards > 0).all())
    assert float(towards @ up) < 0, "a little from above"
    assert start.near < float((model.X - eye).norm(dim=-1).min()) < start.far
    # Another one takes its place.
    before = dict(shown)
    viewer.show(small_model.make("pinhole"))
    assert set(server.shown) == {"/points", "/cameras/0", "/cameras/1", "/cameras/2"}
    assert server.shown["/points"] is not before["/points"]
    viewer.close()
    assert not server.running


def test_the_command_serves_until_it_is_interrupted(
    servers: list[Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_model.make().save(tmp_path / "model.npz")
    opened: list[str] = []
    monkeypatch.setattr(view.webbrowser, "open", lambda address: opened.append(address) or True)

    def wait() -> None:
        assert servers[-1].running
        assert "/points" in servers[-1].shown
        raise KeyboardInterrupt

    monkeypatch.setattr(view, "Event", lambda: SimpleNamespace(wait=wait))
    status, _, stderr = torchsfm("view", tmp_path / "model.npz", "--live", "--port", 8090)
    assert (status, opened) == (0, ["http://127.0.0.1:8090"])
    assert "http://127.0.0.1:8090" in stderr
    assert not servers[-1].running
    assert torchsfm("view", tmp_path / "model.npz", "--live", "--no-browser", "--quiet") == (0, "", "")
    assert len(opened) == 1


def test_without_viser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    small_model.make().save(tmp_path / "model.npz")
    with pytest.raises(ImportError, match=r"pip install 'torchsfm\[viser\]'"):
        LiveViewer()
    status, _, stderr = torchsfm("view", tmp_path / "model.npz", "--live")
    assert status == 2
    assert_one_line(stderr, "pip install 'torchsfm[viser]'")


@pytest.mark.reference
def test_viser_serves_it(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    model: Reconstruction = small_model.with_curves(small_model.make())
    save_image(tmp_path / "a.jpg", torch.ones(3, 600, 800))
    viewer = LiveViewer(port=8150)
    try:
        for _ in range(2):
            viewer.show(model, images=tmp_path)
        with urllib.request.urlopen(viewer.address) as page:
            assert b"<html" in page.read(10_000).lower()
    finally:
        viewer.close()
