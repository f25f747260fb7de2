"""Bundles: what goes in comes out, and every kind of damage is refused by name."""

from __future__ import annotations

import copy
import hashlib
import json
import zipfile

import numpy as np
import pytest
from deploy_synthetic import SCHEMA, SENTENCES, forward, make_bundle, onnx_model, random_observation, weights
from hypothesis import given, settings
from hypothesis import strategies as st

from wbm.deploy.archive import pack, save_arrays
from wbm.deploy.bundle import Bundle
from wbm.deploy.contract import CONTRACT_SCHEMA, Contract
from wbm.deploy.faults import BundleError, Fault, Refused
from wbm.deploy.validate import validate


@pytest.fixture(scope="module")
def bundle_path(tmp_path_factory):
    return make_bundle(tmp_path_factory.mktemp("bundle") / "policy.wbm")


def members_of(path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {n: archive.read(n) for n in archive.namelist()}


def resealed(members: dict[str, bytes], sums: bool = True) -> bytes:
    """An archive with a right seal and, if wished, right checksums: only its content is wrong."""
    members = dict(members)
    if sums:
        members["checksums.json"] = json.dumps(
            {
                k: hashlib.sha256(v).hexdigest()
                for k, v in members.items()
                if k not in ("checksums.json", "signature.json")
            }
        ).encode()
    return pack(members)


def refused(path, data: bytes, verify: bool = False) -> Fault:
    path.write_bytes(data)
    with pytest.raises(BundleError) as caught:
        bundle = Bundle.open(path)
        if verify:
            bundle.verify()
    return caught.value.fault


def test_round_trip(bundle_path):
    bundle = Bundle.open(bundle_path)
    assert bundle.contract.schema == SCHEMA
    assert bundle.verify()["parity"] <= 1e-5
    assert set(bundle.instructions.sentences) == set(SENTENCES)
    inputs, action = bundle.golden
    np.testing.assert_array_equal(inputs["proprio"], random_observation(16)["proprio"])
    assert action.shape == (16, 32)
    assert bundle.show()["provenance"]["student"] == "student/synthetic/0"
    json.dumps(bundle.show())


def test_policy_matches_float64_on_a_dynamic_batch(bundle_path):
    policy = Bundle.open(bundle_path).policy()
    for count in (1, 5, 33):
        observation = random_observation(count, seed=count)
        # float32 sums of 500 products of size 1 against float64
        np.testing.assert_allclose(policy(observation), forward(observation, weights()), atol=1e-5)


def test_same_input_same_bytes(tmp_path):
    assert make_bundle(tmp_path / "a.wbm").read_bytes() == make_bundle(tmp_path / "b.wbm").read_bytes()


def test_golden_vectors_guard_the_export(tmp_path):
    with pytest.raises(BundleError) as caught:
        make_bundle(tmp_path / "a.wbm", gain=1.001)
    assert caught.value.fault is Fault.GOLDEN
    assert not list(tmp_path.iterdir())


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_flipped_bit_anywhere_is_refused(bundle_path, tmp_path_factory, data):
    raw = bytearray(bundle_path.read_bytes())
    index = data.draw(
        st.one_of(st.integers(0, len(raw) - 1), st.integers(0, 60), st.integers(len(raw) - 200, len(raw) - 1))
    )
    raw[index] ^= 1 << data.draw(st.integers(0, 7))
    fault = refused(tmp_path_factory.getbasetemp() / "flipped.wbm", bytes(raw))
    assert fault in {Fault.CHECKSUM, Fault.TRUNCATED, Fault.BUNDLE_VERSION, Fault.NOT_A_BUNDLE}


@settings(max_examples=40, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_cut_file_is_refused(bundle_path, tmp_path_factory, share):
    raw = bundle_path.read_bytes()
    fault = refused(tmp_path_factory.getbasetemp() / "cut.wbm", raw[: int(share * len(raw))])
    assert fault in {Fault.TRUNCATED, Fault.NOT_A_BUNDLE}


def test_not_a_bundle(tmp_path):
    assert refused(tmp_path / "x", b"hello") is Fault.NOT_A_BUNDLE
    assert refused(tmp_path / "x", b"") is Fault.NOT_A_BUNDLE


def test_wrong_content_is_refused_by_name(bundle_path, tmp_path):
    members, path = members_of(bundle_path), tmp_path / "x.wbm"

    def without(name):
        return {k: v for k, v in members.items() if k != name}

    assert refused(path, resealed(without("golden.npz"))) is Fault.MISSING_MEMBER
    assert refused(path, resealed(members | {"policy.onnx": b"x"}, sums=False)) is Fault.CHECKSUM
    assert refused(path, resealed(members | {"extra.bin": b"x"})) is Fault.UNKNOWN_MEMBER
    assert refused(path, resealed(members | {"../evil": b"x"})) is Fault.UNSAFE_PATH
    assert refused(path, resealed(members | {"/etc/x": b"x"})) is Fault.UNSAFE_PATH
    assert refused(path, resealed(members | {"contract.json": b"{"})) is Fault.CONTRACT
    assert refused(path, resealed(members | {"contract.json": b"[1]"})) is Fault.CONTRACT
    assert refused(path, resealed(members | {"policy.onnx": b"junk"}), verify=True) is Fault.ONNX_SIGNATURE
    other = save_arrays({"input/proprio": np.zeros((1, 3), np.float32), "output/action": np.zeros((1, 32), np.float32)})
    assert refused(path, resealed(members | {"golden.npz": other}), verify=True) is Fault.GOLDEN
    pickled = save_arrays({"output/action": np.zeros((1, 32), np.float32)}).replace(b"'<f4'", b"'|O' ")
    assert refused(path, resealed(members | {"golden.npz": pickled}), verify=True) is Fault.CONTRACT


def test_compressed_and_oversized_members_are_refused(bundle_path, tmp_path, monkeypatch):
    members, path = members_of(bundle_path), tmp_path / "x.wbm"
    monkeypatch.setattr("wbm.deploy.archive.MAX_JSON", 100)
    assert refused(path, pack(members)) is Fault.TOO_LARGE
    monkeypatch.setattr("wbm.deploy.archive.MAX_TOTAL", 1000)
    assert refused(path, pack(members)) is Fault.TOO_LARGE


def test_other_versions_are_refused(bundle_path, tmp_path):
    members, path = members_of(bundle_path), tmp_path / "x.wbm"
    contract = json.loads(members["contract.json"])
    contract["format_version"] = 2
    assert refused(path, resealed(members | {"contract.json": json.dumps(contract).encode()})) is Fault.BUNDLE_VERSION
    raw = bundle_path.read_bytes()
    assert refused(path, raw.replace(b"wbm-bundle/1", b"wbm-bundle/2")) is Fault.BUNDLE_VERSION


CONTRACT_DAMAGE = {
    "permuted joints": lambda c: c["joints"]["names"].insert(0, c["joints"]["names"].pop(4)),
    "missing limit": lambda c: c["joints"]["q_min"].pop(),
    "swapped limits": lambda c: c["joints"].update(q_min=c["joints"]["q_max"], q_max=c["joints"]["q_min"]),
    "text for a number": lambda c: c["policy"].update(rate_hz="25"),
    "zero rate": lambda c: c["policy"].update(rate_hz=0),
    "degrees": lambda c: c["units"].update(angle="deg"),
    "other unit of a field": lambda c: c["policy"]["observation"][0].update(unit="mm"),
    "other frame of a field": lambda c: c["policy"]["observation"][0].update(frame="world"),
    "permuted labels": lambda c: c["policy"]["observation"][6]["labels"].reverse(),
    "unknown key": lambda c: c.update(surprise=1),
    "missing frame": lambda c: c["frames"].pop("camera"),
    "loop in the tree": lambda c: c["tree"][3].update(parent=5),
    "joint twice": lambda c: c["tree"][1].update(joint=1),
    "NaN": lambda c: c["joints"]["qd_max"].__setitem__(0, float("nan")),
    "zero scale": lambda c: c["policy"]["action"]["scale"].__setitem__(0, 0.0),
    "true for a number": lambda c: c["policy"].update(rate_hz=True),
}


@pytest.mark.parametrize("name", CONTRACT_DAMAGE)
def test_damaged_contracts_are_refused(bundle_path, name):
    data = copy.deepcopy(Bundle.open(bundle_path).contract.data)
    CONTRACT_DAMAGE[name](data)
    with pytest.raises(BundleError) as caught:
        Contract.from_dict(data)
    assert caught.value.fault is Fault.CONTRACT


def test_contract_schema_agrees_with_jsonschema(bundle_path):
    jsonschema = pytest.importorskip("jsonschema")
    checker = jsonschema.Draft202012Validator(CONTRACT_SCHEMA)
    good = Bundle.open(bundle_path).contract.data
    for name, damage in {"none": lambda c: None, **CONTRACT_DAMAGE}.items():
        data = copy.deepcopy(good)
        damage(data)
        if name == "NaN":  # JSON has no NaN; the package lets Python's pass
            continue
        try:
            validate(data, CONTRACT_SCHEMA)
            ours = True
        except ValueError:
            ours = False
        assert ours == checker.is_valid(data), name


def test_wrong_onnx_inputs_are_refused(bundle_path, tmp_path):
    import onnx

    members = members_of(bundle_path)
    for rename in ("proprio", "depth_xyz"):
        model = onnx.load_from_string(onnx_model(weights()))
        entry = next(i for i in model.graph.input if i.name == rename)
        entry.type.tensor_type.shape.dim[1].dim_value += 1
        fault = refused(tmp_path / "x.wbm", resealed(members | {"policy.onnx": model.SerializeToString()}), verify=True)
        assert fault is Fault.ONNX_SIGNATURE


def test_signature(tmp_path):
    ed25519 = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.ed25519")
    from cryptography.hazmat.primitives import serialization

    keys = [ed25519.Ed25519PrivateKey.generate() for _ in range(2)]
    pem = keys[0].private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (tmp_path / "key.pem").write_bytes(pem)
    raw = [k.public_key().public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw) for k in keys]
    path = make_bundle(tmp_path / "signed.wbm", sign_key=tmp_path / "key.pem")
    assert Bundle.open(path, trusted_key=raw[0]).signer
    with pytest.raises(BundleError, match="not the trusted key"):
        Bundle.open(path, trusted_key=raw[1])
    members = members_of(path)
    provenance = members | {"provenance.json": b'{"student": "someone else"}'}
    assert refused(tmp_path / "x.wbm", resealed(provenance)) is Fault.SIGNATURE
    unsigned = make_bundle(tmp_path / "plain.wbm")
    with pytest.raises(BundleError, match="not signed"):
        Bundle.open(unsigned, trusted_key=raw[0])


def test_instructions(bundle_path):
    cache = Bundle.open(bundle_path).instructions
    np.testing.assert_array_equal(cache.embed("  Pick up the RED mug. "), cache.embed(SENTENCES[0]))
    assert not cache.embed("").any()
    with pytest.raises(Refused) as caught:
        cache.embed("juggle")
    assert caught.value.fault is Fault.UNKNOWN_INSTRUCTION
    cache.encoder = lambda sentences: np.full((len(sentences), 8), 0.5)
    assert (cache.embed("juggle") == 0.5).all()
