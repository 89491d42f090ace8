"""Cameras whose field is a network of any class: gradients, copies, states, files."""

import copy
import json
import math
import pickle
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from kcal import Camera, InputError, Localizer, Origin, Rig, load_camera, save_camera
from kcal.io.rig_file import RigFile, load_rig, save_rig
from kcal.lens import CameraRays, LensModel, Undistort, Unproject, bake
from kcal.lens.model import HybridForm
from kcal.nets import NetworkModes


class Waves(nn.Module):
    """A class that kcal does not know: position encoding, a product, a last layer that is not called last by name."""

    def __init__(self, count: int = 4) -> None:
        super().__init__()
        self.head = nn.Linear(count, 2)
        self.waves = nn.Linear(2, count)
        self.gate = nn.Parameter(torch.linspace(0.5, 1.5, count))

    def forward(self, places: Tensor) -> Tensor:
        result: Tensor = self.head(torch.sin(self.waves(places)) * self.gate)
        return result


class Swirl(nn.Module):
    """Without a linear layer at its end."""

    def __init__(self) -> None:
        super().__init__()
        self.speed = nn.Parameter(torch.tensor([0.7]))

    def forward(self, places: Tensor) -> Tensor:
        square = places.square().sum(-1, keepdim=True)
        return torch.exp(-self.speed * square) * places.flip(-1) * places.new_tensor([-1.0, 1.0])


def network(kind: str) -> nn.Module:
    torch.manual_seed(3)
    if kind == "waves":
        return Waves()
    if kind == "swirl":
        return Swirl()
    return nn.Sequential(nn.Linear(2, 5), nn.SiLU(), nn.Linear(5, 4), nn.Tanh(), nn.Linear(4, 2))


def camera(kind: str, size: float = 0.004) -> Camera:
    modes, weights = NetworkModes.of(network(kind))
    form = HybridForm(shape=0.6, radius=0.95, modes=modes)
    lens = torch.tensor([0.02, 0.003, -0.001, *(size * weights)], dtype=torch.float64)
    values = torch.cat([torch.tensor([800.0, 805.0, 318.0, 243.0, 0.3], dtype=torch.float64), lens])
    return Camera(values, size=(640, 480), model=LensModel(hybrid=form))


KINDS = ("chain", "waves", "swirl")
every = pytest.mark.parametrize("kind", KINDS)


def points() -> Tensor:
    return torch.tensor([[0.3, -0.2, 1.1], [-0.25, 0.1, 0.9], [0.02, 0.3, 1.4]], dtype=torch.float64)


@every
def test_the_network_is_split_before_its_last_layer(kind: str) -> None:
    """Weighted features are the correction, apart from the constant of a bias; the given module stays as it is."""
    given = network(kind)
    before = copy.deepcopy(given.state_dict())
    modes, weights = NetworkModes.of(given)
    x, y = 0.5 * torch.rand(2, 3, 7, dtype=torch.float64)
    wanted = given.double()(torch.stack([x, y], -1).reshape(-1, 2)).reshape(3, 7, 2).detach()
    last = next((part for part in given.modules() if isinstance(part, nn.Linear) and part.out_features == 2), None)
    if last is not None and last.bias is not None:
        wanted = wanted - last.bias.detach()
    found = torch.stack(modes.field(weights, x, y, slopes=False), -1)
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(torch.einsum("m,mcvn->vnc", weights, modes.columns(x, y)), wanted)
    assert all(torch.equal(before[name], value.float()) for name, value in given.state_dict().items())
    assert all(part.requires_grad for part in given.parameters())


@pytest.mark.slow
@every
def test_gradients_by_points_parameters_and_weights(kind: str) -> None:
    """Of projection and of the inverse, whose derivatives follow the implicit function theorem."""
    own = camera(kind)
    names = [name for name, _ in own.field.named_parameters()] if own.field is not None else []
    assert len(names) == {"chain": 4, "waves": 3, "swirl": 1}[kind]
    values = [own.params, *(own.get_parameter(f"field.{name}") for name in names)]
    leaves = [value.detach().clone().requires_grad_() for value in values]

    def with_state(inverse: bool, places: Tensor, *state: Tensor) -> Tensor:
        named = dict(zip(["params", *(f"field.{name}" for name in names)], state, strict=True))
        function = Unproject(own) if inverse else own
        prefixed = {f"camera.{name}": value for name, value in named.items()} if inverse else named
        value: Tensor = functional_call(function, prefixed, (places,))[0]
        return value

    places = points().requires_grad_()
    pixels = own.project(points())[0].detach().requires_grad_()
    for inverse, at in ((False, places), (True, pixels)):
        assert torch.autograd.gradcheck(lambda *v, i=inverse: with_state(i, *v), (at, *leaves), atol=1e-6, rtol=1e-5)
        gradients = torch.autograd.grad(with_state(inverse, at, *leaves).square().sum(), [at, *leaves])
        assert all(float(g.abs().max()) > 0 for g in gradients)


@every
def test_weights_train_when_asked_and_only_then(kind: str) -> None:
    own = camera(kind)
    assert not any(part.requires_grad for part in own.parameters())
    own.free("fx", "field")
    assert all(part.requires_grad for part in own.parameters())
    own.project(points())[0].square().sum().backward()
    assert own.params.grad is not None
    assert own.params.grad.nonzero()[:, 0].tolist() == [0]
    assert own.field is not None
    assert all(float(part.grad.abs().max()) > 0 for part in own.field.parameters() if part.grad is not None)
    own.free("fx")
    assert not any(part.requires_grad for part in own.field.parameters())
    with pytest.raises(InputError, match="unknown parameter 'field'"):
        Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480)).free("field")


def test_a_users_own_loop_trains_it_through_rays() -> None:
    """From pixels to rays, whose gradients come by the implicit function theorem."""
    truth, own = camera("waves"), camera("waves")
    pixels = truth.grid(6, 5).reshape(-1, 2)
    rays = truth.unproject(pixels)[0]
    assert own.field is not None
    with torch.no_grad():
        for part in own.field.parameters():
            part.add_(0.3 * torch.randn(part.shape, generator=torch.Generator().manual_seed(1)))
    own.update_valid_region()
    # These alone: the camera's parameters stay frozen.
    own.field.requires_grad_(True)
    optimizer, losses = torch.optim.Adam(own.field.parameters(), lr=0.03), []
    for _ in range(60):
        optimizer.zero_grad()
        loss = (own.unproject(pixels)[0] - rays).square().sum()
        loss.backward()
        optimizer.step()
        losses.append(float(loss))
    assert losses[-1] < 0.02 * losses[0]


def test_positions_carry_gradients_to_the_weights() -> None:
    """In the rig's own frame and on the Earth, against differences."""
    rig = Rig.pair(camera("waves"), camera("waves"), torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
    rig.left.free("field")
    pixels = rig(torch.tensor([[3.0, 2.0, 300.0], [20.0, -8.0, 150.0]], dtype=torch.float64))[0].unbind(-2)
    assert rig.left.field is not None
    weight = rig.left.get_parameter("field.gate")
    origin = Origin(lat=50.0, lon=8.0, height=100.0)
    for module in (Localizer(rig), Localizer(rig.placed(origin=origin, heading_deg=0.0), pixel_sigma=0.2)):

        def place(module: nn.Module = module) -> Tensor:
            found = module(pixels[0].detach(), pixels[1].detach())
            value: Tensor = found.enu.norm(dim=-1).sum()
            return value

        weight.grad = None
        (gradient,) = torch.autograd.grad(place(), weight)
        step, differences = 1e-5, []
        for k in range(len(weight)):
            sides = []
            for sign in (1.0, -1.0):
                with torch.no_grad():
                    weight[k] += sign * step
                    sides.append(float(place()))
                    weight[k] -= sign * step
            differences.append((sides[0] - sides[1]) / (2.0 * step))
        torch.testing.assert_close(gradient, gradient.new_tensor(differences), rtol=1e-4, atol=1e-3)


@every
def test_copies_are_cameras_of_their_own(kind: str) -> None:
    own = camera(kind)
    for other in (copy.deepcopy(own), pickle.loads(pickle.dumps(own)), own.with_parameters(own.params)):
        assert other.fingerprint == own.fingerprint
        assert other.field is other.model.network
        assert torch.equal(other.project(points())[0], own.project(points())[0])
        with torch.no_grad():
            next(iter(other.field.parameters())).mul_(1.1)  # type: ignore[union-attr]
        assert other.fingerprint != own.fingerprint
        assert other.model != own.model
        assert not torch.equal(other.project(points())[0], own.project(points())[0])


def test_error_bars_do_not_outlive_a_change_of_the_weights() -> None:
    from kcal.lens.calibration import CameraCalibration

    own = camera("waves")
    own.calibration = CameraCalibration(sigma={"fx": 0.5})
    assert own.calibration is not None
    with torch.no_grad():
        own.get_parameter("field.gate").mul_(1.01)
    assert own.calibration is None


@every
def test_states_and_maps_over_cameras(kind: str) -> None:
    """A state carries the weights, and the valid region is measured with them; cameras of one kind are mapped over."""
    own, other = camera(kind), camera(kind, 0.002)
    with torch.no_grad():
        for part in other.field.parameters():  # type: ignore[union-attr]
            part.mul_(1.2)
    blank = camera(kind, 0.0)
    blank.load_state_dict(other.state_dict())
    assert blank.fingerprint == other.fingerprint
    assert torch.equal(blank.inverse_start, other.inverse_start)
    parameters, buffers = stack_module_state([own, other])
    base = copy.deepcopy(own).to("meta")
    found = vmap(lambda p, b: functional_call(base, (p, b), (points(),))[0])(parameters, buffers)
    for k, one in enumerate((own, other)):
        torch.testing.assert_close(found[k], one.project(points())[0], rtol=1e-12, atol=1e-9)
    assert own.double().half().field is own.model.network
    assert all(part.dtype == torch.float64 for part in own.parameters())


@every
def test_it_is_used_as_any_camera(kind: str) -> None:
    own = camera(kind)
    pixels = own.grid(9, 7).reshape(-1, 2)
    rays, valid = own.unproject(pixels)
    assert bool(valid.all())
    torch.testing.assert_close(own.project_rays(rays)[0], pixels, rtol=0, atol=1e-8)
    lookup = bake(own, tolerance=1e-2)
    assert float((lookup.unproject(pixels)[0] - rays).norm(dim=-1).max()) < 2e-5
    image = CameraRays(own)(dtype=torch.float64)
    torch.testing.assert_close(image[0, 240, 320, 3:], own.unproject(torch.tensor([[320.0, 240.0]]))[0][0])
    assert Undistort(own)(torch.rand(1, 3, 480, 640))[0].shape[-2:] == (480, 640)


@every
def test_files(kind: str, tmp_path: Path) -> None:
    own = camera(kind)
    path = save_camera(own, tmp_path / "camera.json")
    # A chain of layers that kcal knows is described in the file; other classes are given.
    field = None if kind == "chain" else network(kind)
    after = load_camera(path, field=field)
    assert after.fingerprint == own.fingerprint
    assert after.model == own.model
    rig = Rig.pair(own, own, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
    assert load_rig(save_rig(rig, tmp_path / "rig.json"), field=field).fingerprint == rig.fingerprint
    many = Rig([own] * 3, ["a", "b", "c"], torch.eye(3).repeat(3, 1, 1), center=torch.eye(3))
    assert RigFile.load(save_rig(many, tmp_path / "many.json")).rig(field).fingerprint == many.fingerprint
    if kind != "chain":
        with pytest.raises(
            InputError, match=rf"{type(network(kind)).__name__}, which is not kcal's and no command can load"
        ):
            load_camera(path)
        with pytest.raises(InputError, match=r"not that of the file.*shape"):
            load_camera(path, field=Waves(5))
    for damage, complaint in (("!", "cannot be read"), ("AAAA", "cannot be read")):
        content = json.loads(path.read_text())
        content["model"]["hybrid"]["network"]["weights"] = damage
        path.write_text(json.dumps(content))
        with pytest.raises((InputError, Exception), match=complaint):
            load_camera(path, field=field)
    plain = save_camera(Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480)), tmp_path / "plain.json")
    with pytest.raises(InputError, match="leave it out"):
        load_camera(plain, field=Waves())


def test_weights_of_another_training_are_refused(tmp_path: Path) -> None:
    """Shapes alone do not tell; the digest does."""
    path = save_camera(camera("waves"), tmp_path / "camera.json")
    content = json.loads(path.read_text())
    other = camera("waves")
    with torch.no_grad():
        other.get_parameter("field.gate").mul_(2.0)
    changed = json.loads(save_camera(other, tmp_path / "other.json").read_text())
    content["model"]["hybrid"]["network"]["weights"] = changed["model"]["hybrid"]["network"]["weights"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="digest"):
        load_camera(path, field=Waves())


class _Other(nn.Module):
    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind, self.layer = kind, nn.Linear(2, 2)
        self.drop = nn.Dropout(0.5)

    def forward(self, places: Tensor) -> Tensor:
        if self.kind == "others":
            return self.layer(places - places.mean(0))
        if self.kind == "one":
            return self.layer(places)[:, :1]
        if self.kind == "nan":
            return self.layer(places) / 0.0
        if self.kind == "drop":
            return self.drop(torch.tanh(places))
        return self.layer(places[:, :1])


@pytest.mark.parametrize(
    ("kind", "complaint"),
    [
        ("others", "each place alone"),
        ("one", r"correction \(N, 2\)"),
        ("nan", "finite"),
        ("drop", "drop-out"),
        ("wrong", "it fails"),
    ],
)
def test_networks_that_are_no_fields(kind: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        NetworkModes.of(_Other(kind))


def test_steeper_features_are_finer() -> None:
    modes = NetworkModes.hidden_layer([(1.0, 0.0, 0.0), (4.0, 0.0, 0.0), (0.0, 8.0, 0.0)])
    degrees = [prior.degree for prior in modes.weight_priors]
    assert degrees[:3] == degrees[3:]
    assert degrees[0] < degrees[1] < degrees[2]
    assert math.isfinite(sum(degrees))
