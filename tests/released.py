"""A model with the released names and shapes, and PyTorch files written without PyTorch."""

import io
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

# Input and output channels of the released sparse convolutions, in their order.
SPARSE_CHANNELS = [(4, 16), (16, 16), (16, 32), *[(32, 32)] * 2, (32, 64), *[(64, 64)] * 8]
# Released convolution and BatchNorm of the neck, with input and output channels and kernel size.
NECK = {
    "bottom_up_block_0.1 bottom_up_block_0.2": (128, 128, 3),
    "bottom_up_block_0.4 bottom_up_block_0.5": (128, 128, 3),
    "bottom_up_block_0.7 bottom_up_block_0.8": (128, 128, 3),
    "bottom_up_block_1.0 bottom_up_block_1.1": (128, 256, 3),
    "bottom_up_block_1.3 bottom_up_block_1.4": (256, 256, 3),
    "bottom_up_block_1.6 bottom_up_block_1.7": (256, 256, 3),
    "trans_0.0 trans_0.1": (128, 128, 1),
    "trans_1.0 trans_1.1": (256, 256, 1),
    "deconv_block_0.0 deconv_block_0.1": (256, 128, 3),
    "deconv_block_1.0 deconv_block_1.1": (256, 128, 3),
    "conv_0.0 conv_0.1": (128, 128, 3),
    "conv_1.0 conv_1.1": (128, 128, 3),
    "w_0.0 w_0.1": (128, 1, 1),
    "w_1.0 w_1.1": (128, 1, 1),
}
LAYOUTS = {"spconv 1": (0, 1, 2, 3, 4), "spconv 2": (4, 0, 1, 2, 3), "spconv 2.0 native": (0, 1, 2, 4, 3)}
State = dict[str, np.ndarray]


def released_state(layout: str = "spconv 1", *, iou: tuple[int, bool] = (3, False), counters: bool = True) -> State:
    """A state dict with the released names and shapes; the same numbers whatever the layout."""
    rng = np.random.default_rng(0)
    state: State = {}

    def draw(name: str, *shape: int) -> None:
        state[name] = rng.normal(size=shape).astype(np.float32)

    def norm(name: str, channels: int) -> None:
        for part in ("weight", "bias", "running_mean", "running_var"):
            draw(f"{name}.{part}", channels)
        if counters:
            state[f"{name}.num_batches_tracked"] = np.array(7)

    for i, (inputs, outputs) in enumerate(SPARSE_CHANNELS):
        name = f"backbone.middle_conv.{3 * i}.weight"
        draw(name, *((3, 1, 1) if i == 13 else (3, 3, 3)), inputs, outputs)
        state[name] = np.ascontiguousarray(state[name].transpose(LAYOUTS[layout]))
        norm(f"backbone.middle_conv.{3 * i + 1}", outputs)
    for names, (inputs, outputs, size) in NECK.items():
        convolution, batch_norm = names.split()
        first, second = (inputs, outputs) if convolution.startswith("deconv") else (outputs, inputs)
        draw(f"neck.{convolution}.weight", first, second, size, size)
        norm(f"neck.{batch_norm}", outputs)
    for branch, channels in {"box": 14, "cls": 2, "dir": 4}.items():
        draw(f"bbox_head.tasks.0.conv_{branch}.weight", channels, 128, 1, 1)
        draw(f"bbox_head.tasks.0.conv_{branch}.bias", channels)
    draw("bbox_head.tasks.0.conv_iou.weight", 2, 128, iou[0], iou[0])
    if iou[1]:
        draw("bbox_head.tasks.0.conv_iou.bias", 2)
    return state


class _Global:
    """Pickled as the function or class `module.name`, which need not exist here."""

    def __init__(self, module: str, name: str) -> None:
        self.text = f"{module}\n{name}\n".encode()


class _Storage:
    def __init__(self, key: str, values: np.ndarray) -> None:
        self.key, self.values = key, values


class _Pickler(pickle._Pickler):
    """Writes arrays as PyTorch writes tensors."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, 2)
        self.storages: list[_Storage] = []

    def persistent_id(self, obj: Any) -> Any:
        if isinstance(obj, _Storage):
            kind = {"f": "FloatStorage", "i": "LongStorage"}[obj.values.dtype.kind]
            return "storage", _Global("torch", kind), obj.key, "cpu", obj.values.size
        return None

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if isinstance(obj, _Global):
            self.write(pickle.GLOBAL + obj.text)
        elif isinstance(obj, np.ndarray):
            self.storages.append(_Storage(str(len(self.storages)), obj))
            strides = tuple(stride // obj.itemsize for stride in np.ascontiguousarray(obj).strides)
            self.save(_Global("torch._utils", "_rebuild_tensor_v2"))
            self.save((self.storages[-1], 0, obj.shape, strides if obj.ndim else (), False, {}))
            self.write(pickle.REDUCE)
        else:
            super().save(obj, save_persistent_id)


def write_pth(path: Path, content: Any, *, legacy: bool = False) -> Path:
    """Write what `torch.save` would, in the zip format or in the older one."""
    file = io.BytesIO()
    pickler = _Pickler(file)
    pickler.dump(content)
    raw = {storage.key: np.ascontiguousarray(storage.values) for storage in pickler.storages}
    if legacy:
        parts = [pickle.dumps(part, 2) for part in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})]
        parts += [file.getvalue(), pickle.dumps(list(raw), 2)]
        parts += [struct.pack("<q", values.size) + values.tobytes() for values in raw.values()]
        path.write_bytes(b"".join(parts))
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", file.getvalue())
            for key, values in raw.items():
                archive.writestr(f"archive/data/{key}", values.tobytes())
    return path
