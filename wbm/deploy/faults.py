"""Every reason for which the runtime or the bundle reader says no, each with a name of its own."""

from __future__ import annotations

from enum import StrEnum


class Fault(StrEnum):
    """Names of refusals. The value is what logs, reports and exit messages carry."""

    # bundle
    NOT_A_BUNDLE = "not-a-bundle"
    TRUNCATED = "truncated"
    BUNDLE_VERSION = "bundle-version"
    CHECKSUM = "checksum"
    UNSAFE_PATH = "unsafe-path"
    TOO_LARGE = "too-large"
    MISSING_MEMBER = "missing-member"
    UNKNOWN_MEMBER = "unknown-member"
    CONTRACT = "contract"
    ONNX_SIGNATURE = "onnx-signature"
    GOLDEN = "golden"
    SIGNATURE = "signature"
    # what a driver says about itself
    DRIVER_MISMATCH = "driver-mismatch"
    # readings
    DROPPED = "dropped"
    WRONG_ORDER = "wrong-order"
    WRONG_SHAPE = "wrong-shape"
    WRONG_TYPE = "wrong-type"
    NOT_FINITE = "not-finite"
    STALE = "stale"
    FUTURE_STAMP = "future-stamp"
    NOT_ADVANCING = "not-advancing"
    UNITS = "units"
    OUT_OF_LIMITS = "out-of-limits"
    VELOCITY = "velocity"
    INCONSISTENT = "inconsistent"
    WORKSPACE = "workspace"
    # policy and driver
    UNKNOWN_INSTRUCTION = "unknown-instruction"
    POLICY_OUTPUT = "policy-output"
    REFLEX = "reflex"
    DISCONNECTED = "disconnected"


class Refused(Exception):
    """A named refusal: nothing was sent to the robot.

    Attributes:
        fault: the name.
        detail: one line: what, where, what to do.
    """

    def __init__(self, fault: Fault, detail: str) -> None:
        super().__init__(f"{fault.value}: {detail}")
        self.fault = fault
        self.detail = detail


class BundleError(Refused):
    """A bundle that is refused on opening or on verification."""
