"""The training loop: batches in, weights out; a run that is killed goes on where it was.

Everything random is drawn from the seed and the number of the step, and the checkpoint holds the
weights, their running mean, and the optimiser's state, so a resumed run ends with the same weights
as one that was never stopped.
"""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.overlap import giou, iou
from sightline.training.architecture import Target, Trainable
from sightline.training.data import Picture

_logger = logging.getLogger(__name__)

CHECKPOINT = "checkpoint.safetensors"
WEIGHTS = "weights.safetensors"
HISTORY = "history.csv"
CONFIGURATION = "config.json"

_FORMAT = 2
"""Of runs: another number, other batches of the same seed."""

_LIBRARIES = (
    "sightline",
    "torch",
    "torchvision",
    "numpy",
    "opencv-python-headless",
)
_LEAST_SCORE = 0.01
_CLIP = 10.0

BatchOf = Callable[[int], tuple[Tensor, list[Target]]]


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained.

    Attributes:
        steps: Batches in all.
        minutes: Of learning after which training stops though there are steps left; validations
            do not count. The learning rate then falls by whichever of the two is nearer to its
            end. Such a run cannot be repeated to the bit: how far it comes is the machine's. 0: no
            limit.
        rate: The highest learning rate, of AdamW.
        weight_decay: Of weights; biases and normalisations have none.
        warmup: Steps over which the rate rises; then it falls as half a cosine.
        last_rate: Where it ends, as a share.
        mean_decay: Of the running mean of the weights, which is what is validated and kept.
        validate_every: Steps between two looks at the validation pictures.
        patience: Validations without a better one after which training stops; 0: never.
        checkpoint_every: Steps between two checkpoints.
        seed: Of whatever is random.
        device: ``"auto"``, ``"cpu"``, ``"cuda"`` or another of torch's.
        precision: ``"auto"``, ``"float32"`` or ``"bfloat16"``: of the convolutions. Automatic is
            bfloat16 on a GPU that has it.
        threads: Of the CPU; 0: as torch likes.
    """

    steps: int = 6000
    minutes: float = 0.0
    rate: float = 2e-3
    weight_decay: float = 0.02
    warmup: int = 200
    last_rate: float = 0.02
    mean_decay: float = 0.998
    validate_every: int = 500
    patience: int = 0
    checkpoint_every: int = 100
    seed: int = 0
    device: str = "auto"
    precision: str = "auto"
    threads: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.validate_every < 1 or self.checkpoint_every < 1:
            raise InputError("steps of training, and between validations, must be 1 or more")
        if not (self.minutes >= 0.0 and math.isfinite(self.minutes)):
            raise InputError(
                f"a training of {self.minutes:g} minutes cannot be; give 0 for no limit"
            )
        if not self.rate > 0.0:
            raise InputError(f"a learning rate of {self.rate:g} is not positive")
        if self.precision not in ("auto", "float32", "bfloat16"):
            raise InputError(
                f"unknown precision {self.precision!r}; known are auto, float32, bfloat16"
            )


@dataclass(frozen=True)
class Validation:
    """How well a network does on pictures that it has not learned from.

    Attributes:
        ap50: Average precision at 0.5 IoU by class name, 0 to 1; NaN where the class has no box.
        giou_loss: Mean of 1 - generalised IoU over the boxes, each with the best of what was found
            of its class; 2 where nothing was.
        score: What is maximised: the mean of the classes that have boxes.
    """

    ap50: Mapping[str, float]
    giou_loss: float
    score: float


@dataclass
class _State:
    step: int = 0
    best_score: float = -1.0
    best_step: int = 0
    elapsed_s: float = 0.0
    learned_s: float = 0.0
    history: list[dict[str, float]] = field(default_factory=list)


@dataclass
class _Lessons:
    """Batches since the last validation.

    Attributes:
        sums: Of each loss, over the batches that taught something.
        taught: How many did.
        skipped: How many did not, since their gradient is not finite.
    """

    sums: dict[str, float] = field(default_factory=dict)
    taught: int = 0
    skipped: int = 0

    def add(self, losses: Mapping[str, float] | None) -> None:
        """Count a batch; None: it was skipped."""
        if losses is None:
            self.skipped += 1
            return
        self.taught += 1
        for name, loss in losses.items():
            self.sums[name] = self.sums.get(name, 0.0) + loss

    def means(self) -> dict[str, float]:
        """The mean of each loss."""
        return {name: value / self.taught for name, value in self.sums.items()}


@dataclass(frozen=True)
class TrainingResult:
    """What a training came to.

    Attributes:
        steps: That were done.
        best_step: Of the weights that were kept.
        best_score: Of those on the validation pictures, or NaN.
        elapsed_s: Over all sittings.
        learned_s: The part of it that is not validations.
        history: A row a validation.
        stopped_early: Whether patience ran out.
    """

    steps: int
    best_step: int
    best_score: float
    elapsed_s: float
    learned_s: float
    history: tuple[Mapping[str, float], ...]
    stopped_early: bool


def train(
    trainable: Trainable,
    batches: BatchOf,
    validation: Sequence[Picture],
    settings: TrainingSettings,
    folder: Path,
    configuration: Mapping[str, object],
    *,
    progress: Callable[[str, float], None] | None = None,
) -> TrainingResult:
    """Train a network, and leave the best weights in it.

    Args:
        trainable: The network; a checkpoint in the folder overwrites its weights.
        batches: A batch by its number, the same whenever it is asked for.
        validation: Pictures to judge by; may be none, then the last weights are kept.
        settings: How.
        folder: Where the checkpoint, the history and the configuration go.
        configuration: All that the result depends on besides; a checkpoint made with another one
            is refused.
        progress: Told what is done, and the share.

    Raises:
        InputError: The folder holds a run with other settings, a damaged checkpoint, or the device
            is not there.
    """
    device = find_device(settings.device)
    if settings.threads:
        torch.set_num_threads(settings.threads)
    wanted = {
        "format": _FORMAT,
        "architecture": trainable.name,
        "classes": list(trainable.class_names),
        "training": asdict(settings),
        **configuration,
    }
    _write_configuration(folder, wanted)
    module = trainable.module.to(device)
    optimizer = torch.optim.AdamW(
        _groups(module, settings.weight_decay), lr=settings.rate, betas=(0.9, 0.99)
    )
    mean = {name: value.detach().clone() for name, value in module.state_dict().items()}
    state = _State()
    identity = _identity(wanted)
    path = folder / CHECKPOINT
    if path.exists():
        state = _load_checkpoint(path, module, optimizer, mean, identity)
    begun = time.monotonic() - state.elapsed_s
    stopped = _patience_spent(state, settings)
    lessons = _Lessons()
    while _done(state, settings) < 1.0 and not stopped:
        started = time.monotonic()
        lessons.add(_step(trainable, batches, optimizer, mean, state, settings, device))
        state.step += 1
        state.learned_s += time.monotonic() - started
        if progress is not None:
            line = _line(state, settings, lessons.means())
            progress(line, min(1.0, _done(state, settings)))
        last = _done(state, settings) >= 1.0
        if state.step % settings.validate_every == 0 or last:
            row = {"step": float(state.step), "elapsed_s": time.monotonic() - begun}
            row |= {f"loss_{name}": value for name, value in lessons.means().items()}
            _tell_of_skipped(lessons, state.step)
            if validation:
                seen = _with_mean(module, mean, lambda: validate(trainable, validation, device))
                row |= {f"ap50_{name}": value for name, value in seen.ap50.items()}
                row |= {"giou_loss": seen.giou_loss, "score": seen.score}
            score = row.get("score", float(state.step))
            state.history.append(row)
            # Of equals the later one: it has learned for longer.
            if score >= state.best_score:
                state.best_score, state.best_step = score, state.step
                save_weights(folder / WEIGHTS, trainable, mean)
            lessons = _Lessons()
            _write_history(folder / HISTORY, state.history)
            stopped = _patience_spent(state, settings)
        if state.step % settings.checkpoint_every == 0 or last or stopped:
            state.elapsed_s = time.monotonic() - begun
            # Sums of losses are not kept, so a checkpoint between validations restarts them.
            _save_checkpoint(path, module, optimizer, mean, state, identity)
    load_weights(folder / WEIGHTS, trainable)
    module.eval()
    return TrainingResult(
        steps=state.step,
        best_step=state.best_step,
        best_score=state.best_score if validation else float("nan"),
        elapsed_s=state.elapsed_s,
        learned_s=state.learned_s,
        history=tuple(state.history),
        stopped_early=stopped and _done(state, settings) < 1.0,
    )


def find_device(name: str) -> torch.device:
    """The device of a name; ``"auto"`` is a GPU where there is one.

    Raises:
        InputError: There is no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"the device {name!r} is not to be had here; use cpu, or auto for what there is"
        ) from error
    return device


def _step(
    trainable: Trainable,
    batches: BatchOf,
    optimizer: torch.optim.Optimizer,
    mean: dict[str, Tensor],
    state: _State,
    settings: TrainingSettings,
    device: torch.device,
) -> dict[str, float] | None:
    """Learn from a batch; returns its losses, or None where its gradient is not finite."""
    number = state.step
    images, targets = batches(number)
    torch.manual_seed(settings.seed * 1_000_003 + number)
    module = trainable.module
    module.train()
    factor = _rate_factor(state, settings)
    for group in optimizer.param_groups:
        group["lr"] = settings.rate * factor * group.get("factor", 1.0)
    images = images.to(device, memory_format=torch.channels_last)
    with _autocast(device, settings.precision):
        losses = trainable.losses(images, [target.to(device) for target in targets])
        total = torch.stack(list(losses.values())).sum()
    optimizer.zero_grad(set_to_none=True)
    total.backward()
    norm = nn.utils.clip_grad_norm_(module.parameters(), _CLIP)
    if not torch.isfinite(norm):
        # One bad batch must not spoil the weights for good.
        _restore_statistics(module, mean)
        return None
    optimizer.step()
    decay = min(settings.mean_decay, (1.0 + number) / (10.0 + number))
    with torch.no_grad():
        for name, value in module.state_dict().items():
            if value.dtype.is_floating_point:
                mean[name].lerp_(value, 1.0 - decay)
            else:
                mean[name].copy_(value)
    return {name: float(loss.detach()) for name, loss in losses.items()}


def _restore_statistics(module: nn.Module, mean: Mapping[str, Tensor]) -> None:
    """Take from the running mean what a batch made infinite in normalisations."""
    with torch.no_grad():
        for name, value in module.named_buffers():
            if name in mean and not bool(torch.isfinite(value).all()):
                value.copy_(mean[name])


def _tell_of_skipped(lessons: _Lessons, step: int) -> None:
    if lessons.skipped:
        _logger.warning(
            "step %d: of the last %d batches %d had a gradient that is not finite, and taught "
            "nothing; a lower learning rate may mend that",
            step,
            lessons.taught + lessons.skipped,
            lessons.skipped,
        )


def _done(state: _State, settings: TrainingSettings) -> float:
    """The share that is done, of the steps or of the minutes."""
    spent = state.learned_s / (60.0 * settings.minutes) if settings.minutes else 0.0
    return max(state.step / settings.steps, spent)


def _rate_factor(state: _State, settings: TrainingSettings) -> float:
    number = float(state.step)
    if settings.minutes:
        number = max(number, settings.steps * _done(state, settings))
    # Short trainings have short beginnings.
    warmup = min(settings.warmup, settings.steps // 5)
    if number < warmup:
        return (number + 1.0) / warmup
    share = (number - warmup) / max(1, settings.steps - warmup)
    cosine = 0.5 * (1.0 + math.cos(math.pi * min(share, 1.0)))
    return settings.last_rate + (1.0 - settings.last_rate) * cosine


def _autocast(device: torch.device, precision: str) -> AbstractContextManager[Any]:
    half = precision == "bfloat16" or (
        precision == "auto" and device.type == "cuda" and torch.cuda.is_bf16_supported()
    )
    return torch.autocast(device.type, torch.bfloat16) if half else nullcontext()


def _groups(module: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    decayed: list[nn.Parameter] = []
    free: list[nn.Parameter] = []
    for parameter in module.parameters():
        if parameter.requires_grad:
            (decayed if parameter.ndim > 1 else free).append(parameter)
    return [
        {"params": decayed, "weight_decay": weight_decay},
        {"params": free, "weight_decay": 0.0},
    ]


def _patience_spent(state: _State, settings: TrainingSettings) -> bool:
    waited = state.step - state.best_step
    return settings.patience > 0 and waited >= settings.patience * settings.validate_every


def _line(state: _State, settings: TrainingSettings, losses: Mapping[str, float]) -> str:
    parts = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
    best = f"; best {state.best_score:.3f}" if state.history else ""
    limit = (
        f", {state.learned_s / 60.0:.1f} of {settings.minutes:g} min" if settings.minutes else ""
    )
    return f"step {state.step} of {settings.steps}{limit}: {parts}{best}"


# ---- judging ----------------------------------------------------------------------------------


def validate(trainable: Trainable, pictures: Sequence[Picture], device: torch.device) -> Validation:
    """Look for boats in whole pictures at their own scale.

    Args:
        trainable: The network.
        pictures: What to look at.
        device: Where the network is.
    """
    module = trainable.module
    was_training = module.training
    module.eval()
    found = []
    for picture in pictures:
        image = torch.from_numpy(_padded(picture.image, trainable.stride).transpose(2, 0, 1).copy())
        batch = (image[None].float() / 255.0).to(device, memory_format=torch.channels_last)
        with torch.no_grad():
            prediction = trainable.predict(batch, _LEAST_SCORE)[0]
        found.append(
            (
                prediction.boxes_xyxy_px.float().cpu().numpy(),
                prediction.scores.float().cpu().numpy(),
                prediction.labels.cpu().numpy(),
            )
        )
    module.train(was_training)
    ap50 = {
        name: _average_precision(pictures, found, label)
        for label, name in enumerate(trainable.class_names)
    }
    known = [value for value in ap50.values() if math.isfinite(value)]
    return Validation(
        ap50=ap50,
        giou_loss=_giou_loss(pictures, found),
        score=float(np.mean(known)) if known else 0.0,
    )


_Found = tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]


def _average_precision(pictures: Sequence[Picture], found: Sequence[_Found], label: int) -> float:
    """Area under precision over recall at 0.5 IoU; boxes on open regions count neither way."""
    scores: list[float] = []
    hits: list[bool] = []
    total = 0
    for picture, (boxes, confidence, labels) in zip(pictures, found, strict=True):
        wanted = ~picture.ignore & (picture.labels == label)
        truth = picture.boxes_xyxy_px[wanted]
        regions = picture.boxes_xyxy_px[picture.ignore]
        taken = np.zeros(len(truth), dtype=bool)
        total += len(truth)
        own = np.flatnonzero(labels == label)
        for i in own[np.argsort(-confidence[own], kind="stable")]:
            overlap = np.where(taken, 0.0, iou(boxes[i], truth))
            best = int(np.argmax(overlap)) if len(overlap) else -1
            if best >= 0 and overlap[best] >= 0.5:
                taken[best] = True
                scores.append(float(confidence[i]))
                hits.append(True)
            elif not _covered(boxes[i], regions):
                scores.append(float(confidence[i]))
                hits.append(False)
    if not total:
        return float("nan")
    if not hits:
        return 0.0
    order = np.argsort(-np.array(scores), kind="stable")
    right = np.cumsum(np.array(hits)[order])
    recall = right / total
    precision = np.maximum.accumulate((right / np.arange(1, len(right) + 1))[::-1])[::-1]
    # As COCO has it: precision at 101 values of recall.
    at = np.searchsorted(recall, np.linspace(0.0, 1.0, 101), side="left")
    return float(np.append(precision, 0.0)[np.minimum(at, len(precision))].mean())


def _giou_loss(pictures: Sequence[Picture], found: Sequence[_Found]) -> float:
    losses = []
    for picture, (boxes, _, labels) in zip(pictures, found, strict=True):
        for truth, label, ignore in zip(
            picture.boxes_xyxy_px, picture.labels, picture.ignore, strict=True
        ):
            if ignore:
                continue
            own = boxes[labels == label]
            losses.append(1.0 - giou(truth, own).max() if len(own) else 2.0)
    return float(np.mean(losses)) if losses else float("nan")


def _covered(box: np.ndarray[Any, Any], regions: np.ndarray[Any, Any]) -> bool:
    """Whether the middle of a box lies in a region."""
    x, y = 0.5 * (box[:2] + box[2:])
    inside = (regions[:, 0] <= x) & (regions[:, 2] >= x)
    return bool((inside & (regions[:, 1] <= y) & (regions[:, 3] >= y)).any())


def _padded(image: np.ndarray[Any, Any], stride: int) -> np.ndarray[Any, Any]:
    height, width = image.shape[:2]
    return np.pad(
        image,
        ((0, -height % stride), (0, -width % stride), (0, 0)),
        constant_values=114,
    )


# ---- files --------------------------------------------------------------------------------------


def save_weights(path: Path, trainable: Trainable, values: Mapping[str, Tensor]) -> None:
    """Write a network's weights, with its name and classes.

    Raises:
        InputError: The file cannot be written.
    """
    about = {"architecture": trainable.name, "classes": list(trainable.class_names)}
    with atomic_path(path) as temporary:
        save_file(
            {name: value.detach().cpu().contiguous() for name, value in values.items()},
            str(temporary),
            metadata={"sightline": json.dumps(about)},
        )


def load_weights(path: Path, trainable: Trainable) -> None:
    """Read weights into a network.

    Raises:
        InputError: The file is missing, damaged, or of another network.
    """
    tensors, about = _read(path)
    if about.get("architecture") != trainable.name:
        raise InputError(
            f"{path}: holds weights of {about.get('architecture')!r}, not of {trainable.name!r}"
        )
    if about.get("classes") != list(trainable.class_names):
        raise InputError(f"{path}: holds weights for other classes than those asked for")
    _put(path, trainable.module, tensors)


def _put(path: Path, module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    try:
        module.load_state_dict(dict(tensors))
    except RuntimeError as error:
        raise InputError(
            f"{path}: holds weights of a network of another size; train into an empty folder"
        ) from error


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        with safe_open(str(path), framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("sightline", "{}"))
            return {name: file.get_tensor(name) for name in file.keys()}, about  # noqa: SIM118
    except (SafetensorError, ValueError, OSError) as error:
        raise InputError(
            f"{path}: is damaged or no file of weights; remove it to begin anew"
        ) from error


def _save_checkpoint(
    path: Path,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    mean: Mapping[str, Tensor],
    state: _State,
    identity: str,
) -> None:
    tensors = {f"module.{name}": value for name, value in module.state_dict().items()}
    tensors |= {f"mean.{name}": value for name, value in mean.items()}
    for number, values in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{number}.{name}": value for name, value in values.items()}
    about = {"identity": identity, "state": asdict(state)}
    with atomic_path(path) as temporary:
        save_file(
            # A copy each: the format takes no two names of one memory.
            {name: value.detach().cpu().clone().contiguous() for name, value in tensors.items()},
            str(temporary),
            metadata={"sightline": json.dumps(about)},
        )


def _load_checkpoint(
    path: Path,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    mean: dict[str, Tensor],
    identity: str,
) -> _State:
    tensors, about = _read(path)
    if about.get("identity") != identity:
        raise InputError(
            f"{path}: is of a run with other settings or other data (see {CONFIGURATION} beside "
            "it); repeat those, or train into an empty folder"
        )
    parts: dict[str, dict[str, Tensor]] = {"module": {}, "mean": {}, "optimizer": {}}
    for name, value in tensors.items():
        group, _, rest = name.partition(".")
        parts[group][rest] = value
    _put(path, module, parts["module"])
    for name, value in parts["mean"].items():
        mean[name].copy_(value)
    content = optimizer.state_dict()
    content["state"] = {}
    for name, value in parts["optimizer"].items():
        number, _, key = name.partition(".")
        content["state"].setdefault(int(number), {})[key] = value
    optimizer.load_state_dict(content)
    return _State(**about["state"])


def _with_mean(
    module: nn.Module, mean: Mapping[str, Tensor], work: Callable[[], Validation]
) -> Validation:
    """Do something with the mean of the weights in the module, then put the weights back."""
    kept = {name: value.detach().clone() for name, value in module.state_dict().items()}
    module.load_state_dict(dict(mean))
    try:
        return work()
    finally:
        module.load_state_dict(kept)


def _identity(configuration: Mapping[str, Any]) -> str:
    """A hash of what the result depends on; where and with how many threads it runs is left out."""
    free = ("device", "threads", "checkpoint_every")
    settings = {k: v for k, v in configuration["training"].items() if k not in free}
    # Without a limit a run is the same as before there were limits.
    if not settings["minutes"]:
        del settings["minutes"]
    content = {k: v for k, v in configuration.items() if k != "versions"} | {"training": settings}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of what takes part, and the machine."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    if torch.cuda.is_available():
        found["gpu"] = torch.cuda.get_device_name()
    return found


def _write_configuration(folder: Path, content: Mapping[str, object]) -> None:
    path = folder / CONFIGURATION
    if path.exists():
        if (folder / CHECKPOINT).exists():
            return
        _refuse_foreign(path)
    with atomic_path(path) as temporary:
        temporary.write_text(
            json.dumps({**content, "versions": versions()}, indent=2) + "\n", encoding="utf-8"
        )


def _refuse_foreign(path: Path) -> None:
    """Refuse to write over a configuration that no training wrote."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        content = None
    if not (isinstance(content, dict) and "architecture" in content):
        raise InputError(f"{path}: is there, and of no training; train into an empty folder")


def _write_history(path: Path, rows: Sequence[Mapping[str, float]]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in rows)
