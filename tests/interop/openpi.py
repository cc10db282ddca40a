"""openpi's own client, as it is on PyPI, against a server of ours: `openpi.py PORT ACTIONS_OF_AN_ANSWER`."""

import sys

import numpy as np
from openpi_client import msgpack_numpy
from openpi_client.action_chunk_broker import ActionChunkBroker
from openpi_client.websocket_client_policy import WebsocketClientPolicy

port, steps = int(sys.argv[1]), int(sys.argv[2])


def connect():
    return WebsocketClientPolicy("127.0.0.1", port, api_key="sesame")


client = connect()
metadata = client.get_server_metadata()
assert metadata["state_width"] == 15 and metadata["action_width"] == 8, metadata
assert metadata["n_action_steps"] == steps, metadata
side = metadata["cameras"][0]["height"]
random = np.random.default_rng(0)
observation = {
    "observation/image": random.integers(0, 256, (side, side, 3), dtype=np.uint8),
    "observation/wrist_image": random.integers(0, 256, (side, side, 3), dtype=np.uint8),
    "observation/state": np.linspace(-0.2, 0.4, 15),
    "prompt": "put the nut on the peg",
    "step": np.int64(3),
    "half": np.zeros(2, np.float16),
    "episode": {"number": 7, "name": None, "done": np.bool_(False)},
}

answer = client.infer(observation)
assert answer["actions"].shape == (steps, 8) and answer["actions"].dtype == np.float32, answer
assert np.isfinite(answer["actions"]).all()
assert answer["server_timing"]["infer_ms"] > 0 and "prev_total_ms" not in answer["server_timing"]
again = client.infer({**observation, "seed": answer["seed"]})
assert (again["actions"] == answer["actions"]).all()
assert again["server_timing"]["prev_total_ms"] > 0
assert not (client.infer(observation)["actions"] == answer["actions"]).all()
print(f"openpi's client: {steps} actions, the same again with seed {answer['seed']}")

history = {key: np.stack([value] * metadata["n_obs_steps"]) for key, value in observation.items() if key.startswith("observation/")}
assert (client.infer({**history, "seed": answer["seed"]})["actions"] == answer["actions"]).all()

broker = ActionChunkBroker(connect(), steps)
actions = [broker.infer(observation)["actions"] for _ in range(steps + 1)]
assert all(a.shape == (8,) for a in actions)
assert not (actions[0] == actions[-1]).all(), "the broker asked once"
print(f"openpi's ActionChunkBroker: {len(actions)} steps of {actions[0].shape}")

wrong = connect()
try:
    wrong.infer({**observation, "observation/state": np.zeros(7, np.float32)})
    sys.exit("expected an error")
except RuntimeError as error:
    assert "observation/state" in str(error) and "[15]" in str(error), error
    print("openpi's client is told:", str(error).splitlines()[-1])
assert client.infer(observation)["actions"].shape == (steps, 8)

# What the tests of e2h-serve hold the writer to.
packed = msgpack_numpy.packb(np.array([1, -2], np.float32))
expected = b"\x84\xc4\x0b__ndarray__\xc3\xc4\x04data\xc4\x08\x00\x00\x80?\x00\x00\x00\xc0\xc4\x05dtype\xa3<f4\xc4\x05shape\x91\x02"
assert packed == expected, packed
