"""The container of every model file: safetensors, with what is no tensor as JSON in its header.  Nothing in it can run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from indexing.files import write_bytes

HEADER = "dyntorch"  # the metadata entry that holds the JSON
AGAIN = "fit on the examples again and save with this version"


def write_model(
    path: str | Path,
    kind: str,
    version: int,
    parameters: Mapping[str, Any],
    about: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
) -> None:
    """Write a fitted estimator, atomically.

    Args:
        kind: of the model, for example ``"dyntorch.action-indexer"``; parameters: of the estimator, less ``device``.
        about: whatever else is no tensor.

    Raises:
        ValueError: the file cannot be written, or a parameter is neither text, number, nor a list of these.
    """
    from safetensors.torch import save as to_bytes

    kept = {name: _plain(value) for name, value in parameters.items() if name != "device"}
    try:
        header = json.dumps({"format": kind, "version": version, "parameters": kept, **about})
    except TypeError as error:
        bad = [name for name, value in kept.items() if not _is_json(value)]
        raise ValueError(
            f"{', '.join(bad)}: a model file holds text, numbers and lists only ({error}); set it to one of these"
        ) from None
    alone = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    write_bytes(Path(path), to_bytes(alone, metadata={HEADER: header}))


def read_model(path: str | Path, kind: str, version: int) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What :func:`write_model` wrote: the header, and the tensors.

    Raises:
        ValueError: no such file, no model file, or one of another kind or version.
    """
    header, tensors = _opened(Path(path), with_tensors=True)
    if header.get("format") != kind:
        found = header.get("format", "nothing that dyntorch wrote")
        raise ValueError(f"{path}: is {found}, but {kind} is expected; give the file that was saved from such an indexer")
    if header.get("version") != version:
        raise ValueError(f"{path}: model version {header.get('version')!r}, this program reads {version}; {AGAIN}")
    return header, tensors


def model_kind(path: str | Path) -> str:
    """What kind of model a file holds, empty where it does not say.

    Raises:
        ValueError: no such file, or no model file.
    """
    return str(_opened(Path(path), with_tensors=False)[0].get("format", ""))


def labels_to_json(classes: NDArray[Any]) -> dict[str, Any]:
    """Class labels for the header.

    Raises:
        ValueError: they are neither text nor numbers.
    """
    if classes.dtype.kind not in "Uiufb" and not (classes.dtype.kind == "O" and all(isinstance(c, str) for c in classes)):
        raise ValueError(f"labels of type {classes.dtype} cannot be saved; use text or numbers")
    return {"values": classes.tolist(), "dtype": classes.dtype.str}


def labels_from_json(found: Mapping[str, Any]) -> NDArray[Any]:
    """What :func:`labels_to_json` made, in the dtype it had."""
    return np.array(found["values"], dtype=np.dtype(found["dtype"]))


def _opened(path: Path, with_tensors: bool) -> tuple[dict[str, Any], dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open

    path = path.expanduser()
    if not path.is_file():
        raise ValueError(f"{path}: no such model file; make one with 'dyntorch index fit ... -o {path.name}'")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(HEADER)
            # cloned, since tensors of the file lie at odd addresses, where products may be rounded otherwise in the last bit
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()} if with_tensors else {}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a model file (safetensors says: {error}); give the file that 'index fit' wrote") from None
    try:
        header = json.loads(text or "{}")
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: its header is damaged ({error}); {AGAIN}") from None
    if not isinstance(header, dict):
        raise ValueError(f"{path}: its header is damaged (no table of values); {AGAIN}")
    return header, tensors


def _plain(value: Any) -> Any:
    """numpy scalars become Python's, arrays and tuples lists."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


def _is_json(value: Any) -> bool:
    try:
        json.dumps(value)
    except TypeError:
        return False
    return True
