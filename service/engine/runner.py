"""The one door to onnxruntime: loads a bundle's graphs and wires them by tensor name."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import onnxruntime as ort  # type: ignore[import-untyped]  # ships no stubs
from jaxtyping import Float, Int64, Shaped

from models.bundle import GraphSpec, Manifest
from service.errors import GraphError, NonFiniteError

Tensors: TypeAlias = dict[str, Shaped[np.ndarray, "..."]]


class Runner:
    """The graphs of one bundle, ready to run; holds no state of any request."""

    def __init__(self, manifest: Manifest, folder: Path, *, threads: int = 1) -> None:
        self.manifest = manifest
        self._sessions = {
            role: _session(folder / graph.file, threads=threads)
            for role, graph in manifest.graphs().items()
        }

    def encode(self, observation: Float[np.ndarray, "T J 3"]) -> Tensors:
        """What later graphs may ask for about one request; every tensor has a batch of one."""
        tensors: Tensors = {"observation": observation[None]}
        if self.manifest.encoder is not None:
            tensors |= self._run("encoder", self.manifest.encoder, tensors)
        return tensors

    def denoise(
        self,
        x_t: Float[np.ndarray, "B ..."],
        *,
        timestep: Int64[np.ndarray, "B"],
        contexts: Sequence[Tensors],
        index: Int64[np.ndarray, "B"],
    ) -> Float[np.ndarray, "B ..."]:
        """x0 as each row's timestep sees it; row i belongs to ``contexts[index[i]]``."""
        if self.manifest.denoiser is None:
            raise GraphError(f"{self.manifest.name}: this bundle has no denoiser.")
        tensors = {"x_t": x_t, "timestep": timestep} | _rows(
            self.manifest.denoiser, contexts, index
        )
        return self._run("denoiser", self.manifest.denoiser, tensors)["x0"]

    def decode(
        self,
        x0: Float[np.ndarray, "B ..."],
        *,
        contexts: Sequence[Tensors],
        index: Int64[np.ndarray, "B"],
    ) -> Float[np.ndarray, "B H J 3"]:
        """Futures in metres, in the world of the observations."""
        tensors = {"x0": x0} | _rows(self.manifest.decoder, contexts, index)
        return self._run("decoder", self.manifest.decoder, tensors)["future"]

    def _run(self, role: str, graph: GraphSpec, tensors: Tensors) -> Tensors:
        names = [output.name for output in graph.outputs]
        try:
            feed = {spec.name: tensors[spec.name] for spec in graph.inputs}
            outputs = dict(zip(names, self._sessions[role].run(names, feed), strict=True))
        except KeyError as error:
            raise GraphError(
                f"{self.manifest.name}: the {role} asks for {error}, which no earlier graph gives."
            ) from error
        except _ORT_ERRORS as error:
            raise GraphError(f"{self.manifest.name}: the {role} could not run.") from error
        for name, output in outputs.items():
            if not np.isfinite(output).all():
                raise NonFiniteError(
                    f"{self.manifest.name}: the {role} gave NaN or infinity in {name}; "
                    "the observation is unlike anything this model was made for."
                )
        return outputs


def _rows(graph: GraphSpec, contexts: Sequence[Tensors], index: Int64[np.ndarray, "B"]) -> Tensors:
    wanted = {spec.name for spec in graph.inputs} & contexts[0].keys()
    return {name: np.concatenate([context[name] for context in contexts])[index] for name in wanted}


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
