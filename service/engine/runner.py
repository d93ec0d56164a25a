"""The one door to onnxruntime: loads a bundle's graphs and wires them by tensor name."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import onnxruntime as ort  # type: ignore[import-untyped]  # ships no stubs
from jaxtyping import Shaped

from models.bundle import Manifest
from service.engine.context import Context, Part, Tensors, gathered, unencoded
from service.errors import GraphError, NonFiniteError


class Runner:
    """The graphs of one bundle, ready to run from several threads; keeps no state."""

    def __init__(self, manifest: Manifest, folder: Path, *, threads: int = 1) -> None:
        self.manifest = manifest
        self._graphs = manifest.graphs()
        self._names = {
            role: (tuple(t.name for t in graph.inputs), tuple(t.name for t in graph.outputs))
            for role, graph in self._graphs.items()
        }
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

        Where another thread encodes one of them, this waits for it.

        Raises:
            EngineError: the encoder cannot run, or gives NaN; no context is changed then.
        """
        with ExitStack() as held:
            # One order for all threads, so that no two wait for each other.
            for context in sorted(unencoded(contexts), key=id):
                held.enter_context(context.lock)
            waiting = unencoded(contexts)
            if waiting and "encoder" in self._graphs:
                outputs = self.run("encoder", {}, [(context, len(context)) for context in waiting])
                start = 0
                for context in waiting:
                    end = start + len(context)
                    context.tensors |= {name: rows[start:end] for name, rows in outputs.items()}
                    start = end
            for context in waiting:
                context.encoded = True

    def run(self, role: str, tensors: Tensors, parts: Sequence[Part]) -> Tensors:
        """What a graph makes of a batch of rows: of their own tensors and their contexts'.

        Raises:
            GraphError: the graph cannot run, or asks for a tensor that nothing gives.
            NonFiniteError: it gives NaN or infinity.
        """
        asked, names = self._names[role]
        given = gathered([name for name in asked if name not in tensors], parts) | tensors
        missing = [name for name in asked if name not in given]
        if missing:
            raise GraphError(
                f"{self.manifest.name}: the {role} asks for {missing[0]!r}, "
                "which no earlier graph gives."
            )
        feed = {name: _two_or_more(given[name]) for name in asked}
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
        num_rows = sum(count for _, count in parts)
        return {name: output[:num_rows] for name, output in outputs.items()}


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
