"""Write, open, show and verify a bundle: one file that carries a policy and everything a robot must agree with."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from wbm.deploy.archive import load_arrays, pack, save_arrays, unpack
from wbm.deploy.contract import Contract
from wbm.deploy.faults import BundleError, Fault
from wbm.deploy.instructions import InstructionCache
from wbm.deploy.policy import OnnxPolicy
from wbm.deploy.signature import check_signature, sign

_REQUIRED = ("checksums.json", "contract.json", "golden.npz", "instructions.npz", "policy.onnx", "provenance.json")
_ALLOWED = frozenset((*_REQUIRED, "signature.json"))


def _dump(data: Any) -> bytes:
    return (json.dumps(data, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n").encode()


def write_bundle(
    path: str | Path,
    *,
    onnx: bytes,
    contract: Contract,
    golden_inputs: dict[str, np.ndarray],
    golden_action: np.ndarray,
    instructions: InstructionCache,
    provenance: dict[str, Any],
    sign_key: str | Path | None = None,
) -> Path:
    """Write a bundle atomically and check it by opening it again.

    Args:
        path: where to; `.wbm` by custom.
        onnx: the model, opset 18, dynamic batch; inputs are the schema's fields by name, output `action` [B,32].
        contract: from `make_contract`.
        golden_inputs: observations [G,...] by field.
        golden_action: what the trained network answers to them [G,32], not what the ONNX model answers.
        instructions: sentences and embeddings.
        provenance: JSON-ready: inputs, digests, versions.
        sign_key: PEM file of an ed25519 private key.

    Returns:
        The path.

    Raises:
        BundleError: `GOLDEN` when the model does not reproduce the golden vectors, or any fault of `Bundle.open`.
    """
    arrays = {f"input/{k}": np.asarray(v) for k, v in golden_inputs.items()}
    arrays["output/action"] = np.asarray(golden_action, dtype=np.float32)
    members = {
        "policy.onnx": onnx,
        "contract.json": _dump(contract.data),
        "golden.npz": save_arrays(arrays),
        "instructions.npz": save_arrays(instructions.to_arrays()),
        "provenance.json": _dump(provenance),
    }
    members["checksums.json"] = _dump({k: hashlib.sha256(v).hexdigest() for k, v in members.items()})
    if sign_key:
        members["signature.json"] = sign(members["checksums.json"], Path(sign_key))
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    with open(partial, "wb") as stream:
        stream.write(pack(members))
        stream.flush()
        os.fsync(stream.fileno())
    try:
        Bundle.open(partial).verify()
    except BundleError:
        partial.unlink()
        raise
    os.replace(partial, path)
    return path


@dataclass(frozen=True)
class Bundle:
    """An opened bundle; everything is in memory, checksums and contract have been checked.

    Attributes:
        path: the file.
        contract: the validated contract.
        provenance: where the policy comes from.
        digest: SHA-256 of the checksums, the bundle's identity.
        signer: public key (base64) of a verified signature, or an empty string.
    """

    path: Path
    contract: Contract
    provenance: dict[str, Any]
    digest: str
    signer: str
    _members: dict[str, bytes]

    @staticmethod
    def open(path: str | Path, trusted_key: bytes | None = None) -> Bundle:
        """Open and check a bundle; nothing in it is executed.

        Args:
            path: the file.
            trusted_key: raw ed25519 public key (32 bytes) that must have signed it.

        Raises:
            FileNotFoundError: no such file.
            BundleError: the first fault found, by name.
        """
        path = Path(path)
        members = unpack(path, _ALLOWED)
        for name in _REQUIRED:
            if name not in members:
                raise BundleError(Fault.MISSING_MEMBER, f"{path} lacks {name}")
        sums = _load_json(members["checksums.json"], "checksums.json", Fault.CHECKSUM)
        expected = set(_REQUIRED) - {"checksums.json"}
        if set(sums) != expected:
            raise BundleError(
                Fault.CHECKSUM, f"{path}: checksums.json lists {sorted(sums)}, expected {sorted(expected)}"
            )
        for name, digest in sums.items():
            if hashlib.sha256(members[name]).hexdigest() != digest:
                raise BundleError(Fault.CHECKSUM, f"{path}: {name} does not match its checksum; fetch the bundle again")
        signer = ""
        if "signature.json" in members and (trusted_key is not None or _can_check()):
            signer = check_signature(members["checksums.json"], members["signature.json"], trusted_key)
        elif trusted_key is not None:
            raise BundleError(Fault.SIGNATURE, f"{path} is not signed, but a trusted key was asked for")
        contract = Contract.from_dict(_load_json(members["contract.json"], "contract.json", Fault.CONTRACT))
        provenance = _load_json(members["provenance.json"], "provenance.json", Fault.CONTRACT)
        identity = hashlib.sha256(members["checksums.json"]).hexdigest()
        return Bundle(path, contract, provenance, identity, signer, members)

    @cached_property
    def instructions(self) -> InstructionCache:
        """Cached sentences; set `.encoder` to accept new ones."""
        arrays = load_arrays(self._members["instructions.npz"], "instructions.npz")
        return InstructionCache.from_arrays(arrays, self.contract.schema.text_dim)

    @cached_property
    def golden(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Golden observations [G,...] by field and the actions [G,32] that belong to them."""
        arrays = load_arrays(self._members["golden.npz"], "golden.npz")
        if "output/action" not in arrays or arrays["output/action"].shape[1:] != (self.contract.schema.action.size,):
            raise BundleError(Fault.CONTRACT, "golden.npz lacks output/action [G,32]")
        return {k.removeprefix("input/"): v for k, v in arrays.items() if k.startswith("input/")}, arrays[
            "output/action"
        ]

    def policy(self, threads: int = 1) -> OnnxPolicy:
        """The network, ready to run."""
        return OnnxPolicy(self._members["policy.onnx"], self.contract.schema, threads)

    def member(self, name: str) -> bytes:
        """Raw bytes of a member."""
        return self._members[name]

    def verify(self) -> dict[str, Any]:
        """Run the golden vectors and return what was measured.

        Returns:
            `parity` (largest difference), `tolerance`, `num_golden`, `num_instructions`, `digest`, `signer`.

        Raises:
            BundleError: `GOLDEN` beyond the contract's tolerance, or `ONNX_SIGNATURE`.
        """
        inputs, action = self.golden
        try:
            policy = self.policy()
            answer = policy(inputs)
            single = policy({k: v[:1] for k, v in inputs.items()})  # as on the robot: catches a model that mixes rows
        except ValueError as error:
            raise BundleError(Fault.GOLDEN, f"golden.npz: {error}") from error
        tolerance = self.contract.data["parity_tolerance"]
        if answer.shape != action.shape or not np.isfinite(action).all():
            raise BundleError(
                Fault.GOLDEN, f"golden.npz: expected actions {action.shape}, the model answers {answer.shape}"
            )
        parity = float(max(np.abs(answer - action).max(), np.abs(single - action[:1]).max()))
        if parity > tolerance:
            raise BundleError(
                Fault.GOLDEN, f"the model differs from its golden vectors by {parity:.3g}, allowed {tolerance:.3g}"
            )
        return {
            "parity": parity,
            "tolerance": tolerance,
            "num_golden": len(action),
            "num_instructions": len(self.instructions),
            "digest": self.digest,
            "signer": self.signer,
        }

    def show(self) -> dict[str, Any]:
        """What a person wants to know first, JSON-ready."""
        c = self.contract
        return {
            "name": c.data["name"],
            "path": str(self.path),
            "digest": self.digest,
            "signer": self.signer or None,
            "size_bytes": {k: len(v) for k, v in sorted(self._members.items())},
            "rate_hz": c.schema.rate_hz,
            "observation": [
                {"name": f.name, "shape": list(f.shape), "dtype": f.dtype, "unit": f.unit, "frame": f.frame}
                for f in c.schema.observation
            ],
            "action": {"size": c.schema.action.size, "limit": c.schema.action.limit, "joints": list(c.joint_names)},
            "delays": c.data["delays"],
            "max_age": c.data["max_age"],
            "workspace": c.data["workspace"],
            "instructions": list(self.instructions.sentences),
            "provenance": self.provenance,
        }


def _can_check() -> bool:
    """Whether signatures can be checked here; if not, and no key is asked for, `signer` stays empty."""
    return find_spec("cryptography") is not None


def _load_json(data: bytes, name: str, fault: Fault) -> dict[str, Any]:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise BundleError(fault, f"{name} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise BundleError(fault, f"{name} must hold one JSON object")
    return value
