"""A model file and the ONNX session that runs it, on whatever this machine has."""

from __future__ import annotations

import math
import os
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import onnxruntime as ort

from swarmtrack.detection.onnx_file import count_nodes
from swarmtrack.errors import ModelError
from swarmtrack.plain_text import plain

SHIPPED = ("default",)

PROVIDERS: dict[str, str] = {
    "cpu": "CPUExecutionProvider",
    "xnnpack": "XnnpackExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "qnn": "QNNExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
}

ENGINE_CACHES: dict[str, dict[str, str]] = {
    "tensorrt": {
        "trt_engine_cache_enable": "True",
        "trt_engine_cache_path": "{cache}",
        "trt_timing_cache_enable": "True",
        "trt_timing_cache_path": "{cache}",
    },
    "openvino": {"cache_dir": "{cache}"},
    "coreml": {"ModelCacheDirectory": "{cache}"},
}
ELEMENTS = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
"""Types of input that a net may have."""
SIZE_ELEMENTS = {"tensor(int64)": np.int64, "tensor(int32)": np.int32}
SMALLEST_NET_INPUT_PX = 16
MOST_INPUT_PIXELS = 3840 * 2160
"""As floats, 100 MB."""
MOST_OUTPUT_NUMBERS = 50_000_000
"""200 MB as floats; a YOLO of 80 classes has 14 million for a 4K image."""
MOST_FOLDED_BYTES = 256 << 20
"""Of all constants that are computed when a net is loaded; foreign nets need some megabytes."""
FOLDING_IS_BOUNDED = (1, 27)
"""Version of ONNX Runtime that can bound them."""
MOST_NET_BYTES, NET_MEMORY_SHARE = 2 << 30, 0.5
"""Of all nets on the CPU together, and of this machine's memory; a YOLO at 4K takes about 1 GB."""
LONGEST_RUNTIME_REASON = 300  # characters of ONNX Runtime's
TRIAL_S, COMPILING_S = 30.0, 1200.0  # s for the first answer; where an accelerator compiles the net before

MEMORY_REFUSED = re.compile(
    r"running (?P<node>\w{1,60}) node\b.*\b"
    r"(?:requested bytes of|requested buffer of size|require more than) (?P<bytes>\d{1,20})",
    re.DOTALL,
)
"""In ONNX Runtime's words."""

T = TypeVar("T")


def model_path(model: str | Path) -> Path:
    """Path of a shipped model's file by name, or the path itself."""
    if str(model) in SHIPPED:
        return Path(str(resources.files("swarmtrack.detection") / "models" / f"{model}.onnx"))
    return Path(model)


def second_stage_path(model: str | Path) -> Path:
    """Path of a second stage's file, likewise."""
    if str(model) in SHIPPED:
        return Path(str(resources.files("swarmtrack.detection") / "models" / "second_stage.onnx"))
    return Path(model)


def metadata_of(path: Path) -> Mapping[str, str]:
    """Metadata in a model's file."""
    session = open_session(path, 1, ("cpu",))
    written: Mapping[str, str] = session.get_modelmeta().custom_metadata_map
    return written


def cache_folder() -> Path:
    """Folder of the engines that a provider compiles: minutes on a Jetson, once and not at every start."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.path.expanduser(base), "swarmtrack", "engines")


def open_session(
    path: Path, threads: int, providers: Sequence[str], cache: Path | None = None
) -> ort.InferenceSession:
    """Load a model on the first of `providers` (names of `PROVIDERS`) that this machine has and that can run it;
    the others, and the CPU in any case, take over what it cannot. cache: of compiled engines, instead of
    `cache_folder`."""
    unknown = [name for name in providers if name not in PROVIDERS]
    if unknown or not providers:
        raise ModelError(
            f"detector providers: found {list(providers)}, expected some of {', '.join(PROVIDERS)}"
        )
    available = ort.get_available_providers()
    usable = [name for name in providers if PROVIDERS[name] in available]
    if not usable:
        have = ", ".join(name for name, long in PROVIDERS.items() if long in available)
        raise ModelError(f"detector providers: none of {', '.join(providers)} is installed here, only {have}")
    if not os.path.isfile(path):
        raise ModelError(
            f'{path}: no such model file; expected an ONNX file, or "default" for the one that is shipped'
        )
    nodes = 0 if path.suffix == ".ort" else count_nodes(path)
    limit_memory()
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    # Spinning threads burn a core between frames, which the tracker and the links need.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.use_env_allocators", "1")
    most_folded = str(MOST_FOLDED_BYTES // max(1, nodes))
    options.add_session_config_entry("optimization.constant_folding_max_output_size_in_bytes", most_folded)
    left_out = [] if _version() >= FOLDING_IS_BOUNDED else ["ConstantFolding"]
    options.log_severity_level = 4  # the exception says it; the C++ log would only repeat it on stderr
    chosen = [(PROVIDERS[name], _options(name, cache or cache_folder(), threads)) for name in usable]
    try:
        session = ort.InferenceSession(str(path), options, providers=chosen, disabled_optimizers=left_out)
    except Exception as error:  # ONNX Runtime's exceptions have no common base but this
        why = plain(str(error), LONGEST_RUNTIME_REASON)
        raise ModelError(
            f"{path}: not a model that ONNX Runtime {ort.__version__} can load: {why}"
        ) from error
    for output in session.get_outputs():
        # Sizes that depend on the input are words.
        if math.prod(side for side in output.shape or () if isinstance(side, int)) > MOST_OUTPUT_NUMBERS:
            raise ModelError(
                f"{path}: its output {plain(output.name, 64)} has the shape {plain(str(output.shape), 200)}, expected "
                f"{MOST_OUTPUT_NUMBERS} numbers at most"
            )
    return session


@lru_cache(maxsize=1)
def limit_memory() -> int:
    """Most bytes that all nets of this process take on the CPU, from now on."""
    here = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    most = min(MOST_NET_BYTES, int(NET_MEMORY_SHARE * here))
    place = ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT)
    # -1: as ONNX Runtime chooses.
    ort.create_and_register_allocator(place, ort.OrtArenaCfg(most, -1, -1, -1))
    return most


def _version() -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", ort.__version__)[:2])


def _options(provider: str, cache: Path, threads: int) -> Mapping[str, Any]:
    """What each provider must be told, by the names of its own documentation."""
    if provider in ENGINE_CACHES:
        cache.mkdir(parents=True, exist_ok=True)
        return {key: value.format(cache=cache) for key, value in ENGINE_CACHES[provider].items()}
    return {"intra_op_num_threads": str(threads)} if provider == "xnnpack" else {}


def runs_on(session: ort.InferenceSession) -> tuple[str, ...]:
    """The providers that really run a session, by short name, the first one first."""
    short = {long: name for name, long in PROVIDERS.items()}
    return tuple(short.get(long, long) for long in session.get_providers())


def trial_limit(session: ort.InferenceSession) -> float:
    """Time limit [s] for the first answer of a session."""
    return (
        TRIAL_S if runs_on(session) == ("cpu",) else COMPILING_S
    )  # accelerators compile it first, some for minutes


def first_answer(path: Path, ask: Callable[[ort.RunOptions], T], *, limit_s: float, what: str) -> T:
    """First answer of an untrusted net; `ModelError` where it fails or does not end. what: the input."""
    options = ort.RunOptions()
    ending = threading.Timer(limit_s, setattr, (options, "terminate", True))
    ending.daemon = True
    ending.start()
    try:
        return ask(options)
    except ModelError:
        raise
    except Exception as error:  # ONNX Runtime's exceptions have no common base but this
        if options.terminate:
            raise ModelError(
                f"{path}: no answer within {limit_s:g} s to {what}, expected a detector that is fast enough for a "
                "flight"
            ) from None
        asked = MEMORY_REFUSED.search(str(error))
        if asked is not None:
            raise ModelError(
                f"{path}: its {asked['node']} asks for {1e-9 * float(asked['bytes']):.3g} GB of memory on {what}, "
                f"expected {1e-9 * limit_memory():.3g} GB at most for all of a net"
            ) from None
        raise ModelError(
            f"{path}: cannot run on {what}: {plain(str(error), LONGEST_RUNTIME_REASON)}"
        ) from error
    finally:
        ending.cancel()


class NetInput(NamedTuple):
    """What a net is fed. name, element: of the image (1, channels, height, width); fixed_size: its (width, height) px,
    None where any will do; size_name, size_element: of a second input (1, 2), the image's size [px], None without one.
    """

    name: str
    element: type
    channels: int
    fixed_size: tuple[int, int] | None
    size_name: str | None = None
    size_element: type = np.int64


def check_input(path: Path, session: ort.InferenceSession) -> NetInput:
    """The inputs of a net. Raises `ModelError` where they are not an image's."""
    inputs = session.get_inputs()
    images = [entry for entry in inputs if len(entry.shape) == 4]
    sizes = [entry for entry in inputs if entry.type in SIZE_ELEMENTS and entry.shape[1:] == [2]]
    shape = images[0].shape if images else [0, 0, 0, 0]
    good = len(images) == 1 and images[0].type in ELEMENTS and shape[1] in (1, 3)
    good &= len(inputs) == 1 or (len(inputs) == 2 and len(sizes) == 1)
    if not good or (isinstance(shape[0], int) and shape[0] != 1):
        found = "; ".join(f"{entry.name} {entry.type} {entry.shape}" for entry in inputs[:8]) or "none"
        last = " (its channels are last: export it with the channels first)" if shape[3] in (1, 3) else ""
        raise ModelError(
            f"{path}: inputs are {plain(found)}{last}; expected one image of type {' or '.join(ELEMENTS)} and shape "
            "[1, 3 or 1, height, width], and at most the image's size, int64 [1, 2]"
        )
    height, width = shape[2], shape[3]
    fixed = (width, height) if isinstance(width, int) and isinstance(height, int) else None
    if fixed is not None and not (
        min(fixed) >= SMALLEST_NET_INPUT_PX and width * height <= MOST_INPUT_PIXELS
    ):
        raise ModelError(
            f"{path}: its input is {width}x{height} px, expected a detector's: {SMALLEST_NET_INPUT_PX} px at least on "
            f"each side, and {MOST_INPUT_PIXELS / 1e6:.1f} megapixels at most"
        )
    size = (sizes[0].name, SIZE_ELEMENTS[sizes[0].type]) if sizes else (None, np.int64)
    return NetInput(images[0].name, ELEMENTS[images[0].type], shape[1], fixed, *size)
