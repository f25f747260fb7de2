"""Optional ed25519 signature over a bundle's checksums (needs `cryptography`, which the runtime does not)."""

from __future__ import annotations

import base64
import json
from pathlib import Path

from wbm.deploy.faults import BundleError, Fault


def sign(message: bytes, key_path: Path) -> bytes:
    """The signature document of `message`, JSON.

    Args:
        message: the bytes of `checksums.json`.
        key_path: an ed25519 private key, PEM, without a passphrase.

    Raises:
        ValueError: the key is of another kind.
    """
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key = serialization.load_pem_private_key(key_path.read_bytes(), password=None)
    if not isinstance(key, Ed25519PrivateKey):
        raise ValueError(
            f"deploy.sign_key {key_path} is no ed25519 key; make one with `openssl genpkey -algorithm ed25519`"
        )
    public = key.public_key().public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    document = {
        "algorithm": "ed25519",
        "public_key": base64.b64encode(public).decode(),
        "signature": base64.b64encode(key.sign(message)).decode(),
    }
    return json.dumps(document, indent=1, sort_keys=True).encode()


def check_signature(message: bytes, document: bytes, trusted: bytes | None) -> str:
    """Verify a signature document and return the public key (base64).

    Args:
        message: the bytes of `checksums.json`.
        document: the bytes of `signature.json`.
        trusted: raw 32 bytes of the key that must have signed, or None to accept any.

    Raises:
        BundleError: `SIGNATURE`.
    """
    try:
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    except ImportError as error:
        raise BundleError(Fault.SIGNATURE, "checking a signature needs `pip install cryptography`") from error
    try:
        data = json.loads(document)
        public = base64.b64decode(data["public_key"], validate=True)
        Ed25519PublicKey.from_public_bytes(public).verify(base64.b64decode(data["signature"], validate=True), message)
    except (ValueError, KeyError, TypeError, InvalidSignature) as error:
        raise BundleError(Fault.SIGNATURE, "the signature does not belong to this bundle") from error
    if trusted is not None and public != trusted:
        raise BundleError(Fault.SIGNATURE, f"signed by {data['public_key']}, which is not the trusted key")
    return data["public_key"]
