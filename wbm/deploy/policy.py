"""The exported network behind a checked signature."""

from __future__ import annotations

import numpy as np
import onnxruntime as ort

from wbm.deploy.faults import BundleError, Fault, Refused
from wbm.robot.schema import PolicySchema

_TYPES = {"float32": "tensor(float)", "uint8": "tensor(uint8)"}


class OnnxPolicy:
    """Maps observations [B, ...] to actions [B, 32] on the CPU.

    Args:
        model: the bytes of `policy.onnx`; a model that refers to files beside it cannot be loaded from bytes.
        schema: the fields that its inputs must be.
        threads: threads onnxruntime may use.

    Raises:
        BundleError: `ONNX_SIGNATURE` when inputs or outputs differ from the schema.
    """

    def __init__(self, model: bytes, schema: PolicySchema, threads: int = 1) -> None:
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own classes share no base but Exception
            raise BundleError(
                Fault.ONNX_SIGNATURE, f"policy.onnx cannot be loaded: {str(error).splitlines()[0]}"
            ) from error
        self.schema = schema
        self._fields = schema.observation
        found = {i.name: (i.type, tuple(i.shape)) for i in self._session.get_inputs()}
        for field in self._fields:
            kind, shape = found.pop(field.name, ("", ()))
            if kind != _TYPES[field.dtype] or tuple(shape[1:]) != field.shape or isinstance(shape[0], int):
                raise BundleError(
                    Fault.ONNX_SIGNATURE,
                    f"policy.onnx input {field.name!r} is {kind or 'missing'} {list(shape)}, "
                    f"expected {_TYPES[field.dtype]} ['batch', {field.shape}]",
                )
        outputs = {o.name: tuple(o.shape) for o in self._session.get_outputs()}
        if found or "action" not in outputs or outputs["action"][1:] != (schema.action.size,):
            raise BundleError(
                Fault.ONNX_SIGNATURE,
                f"policy.onnx has extra inputs {sorted(found)} and outputs {outputs}; "
                "expected output 'action' [batch, 32]",
            )

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Actions [B,32] of observations [B,...]; arrays are cast to the schema's types.

        Raises:
            ValueError: the observation does not fit the schema.
            Refused: `POLICY_OUTPUT` when the network answers with values that are not finite.
        """
        self.schema.check(observation)
        feed = {f.name: np.ascontiguousarray(observation[f.name], dtype=f.dtype) for f in self._fields}
        action = np.asarray(self._session.run(["action"], feed)[0])
        if not np.isfinite(action).all():
            raise Refused(Fault.POLICY_OUTPUT, "the network returned values that are not finite")
        return action
