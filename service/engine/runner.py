"""The one door to onnxruntime: loads a bundle's graphs and wires them by tensor name."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnxruntime as ort  # type: ignore[import-untyped]  # ships no stubs
from jaxtyping import Shaped

from models.bundle import Manifest
from service.engine.context import Context, Tensors, distinct, gathered
from service.errors import GraphError, NonFiniteError


class Runner:
    """The graphs of one bundle, ready to run; keeps no state of any request."""

    def __init__(self, manifest: Manifest, folder: Path, *, threads: int = 1) -> None:
        self.manifest = manifest
        self._graphs = manifest.graphs()
        self._sessions = {
            role: _session(folder / graph.file, threads=threads)
            for role, graph in self._graphs.items()
        }

    def takes(self, role: str, name: str) -> bool:
        """Whether the bundle has a graph of this role that asks for a tensor of this name."""
        graph = self._graphs.get(role)
        return graph is not None and any(spec.name == name for spec in graph.inputs)

    def encode(self, contexts: Sequence[Context]) -> None:
        """Add what the encoder gives to those contexts that lack it, in one batch.

        Raises:
            EngineError: the encoder cannot run, or gives NaN; no context is changed then.
        """
        waiting = [context for context in distinct(contexts) if not context.encoded]
        if waiting and "encoder" in self._graphs:
            outputs = self.run("encoder", {}, waiting)
            for i, context in enumerate(waiting):
                context.tensors |= {name: rows[i : i + 1] for name, rows in outputs.items()}
        for context in waiting:
            context.encoded = True

    def run(self, role: str, tensors: Tensors, contexts: Sequence[Context]) -> Tensors:
        """What a graph makes of a batch of rows: of their own tensors and their contexts'.

        Raises:
            GraphError: the graph cannot run, or asks for a tensor that nothing gives.
            NonFiniteError: it gives NaN or infinity.
        """
        graph = self._graphs[role]
        asked = [spec.name for spec in graph.inputs]
        given = gathered([name for name in asked if name not in tensors], contexts) | tensors
        missing = [name for name in asked if name not in given]
        if missing:
            raise GraphError(
                f"{self.manifest.name}: the {role} asks for {missing[0]!r}, "
                "which no earlier graph gives."
            )
        feed = {name: _two_or_more(given[name]) for name in asked}
        names = [output.name for output in graph.outputs]
        try:
            outputs = dict(zip(names, self._sessions[role].run(names, feed), strict=True))
        except _ORT_ERRORS as error:
            raise GraphError(f"{self.manifest.name}: the {role} could not run.") from error
        for name, output in outputs.items():
            if not np.isfinite(output).all():
                raise NonFiniteError(
                    f"{self.manifest.name}: the {role} gave NaN or infinity in {name}; "
                    "the observation is unlike anything this model was made for."
                )
        return {name: output[: len(contexts)] for name, output in outputs.items()}


def _two_or_more(rows: Shaped[np.ndarray, "B ..."]) -> Shaped[np.ndarray, "C ..."]:
    # onnxruntime multiplies a single row by another routine, which rounds otherwise.
    return np.repeat(rows, 2, axis=0) if len(rows) == 1 else rows


# onnxruntime's exceptions share no base; they are those of its extension module, and two of ours.
_ORT_ERRORS: tuple[type[Exception], ...] = (
    RuntimeError,
    ValueError,
    *(
        error
        for error in vars(ort.capi.onnxruntime_pybind11_state).values()
        if isinstance(error, type) and issubclass(error, Exception)
    ),
)


def _session(path: Path, *, threads: int) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Several graphs take turns: a pool that spins while another works only takes its core.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except _ORT_ERRORS as error:
        raise GraphError(f"{path.parent.name}/{path.name}: onnxruntime cannot load it.") from error
