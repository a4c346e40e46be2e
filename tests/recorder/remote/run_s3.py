"""Upload a log to an S3 server on 127.0.0.1, and read it from there; test_s3.py runs this script.

    python run_s3.py LOG

The script prints the fingerprint and the number of episodes of the remote log, and the names in the
bucket.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

KEYS = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_DEFAULT_REGION": "us-east-1",
}


def main(log: str) -> dict[str, Any]:
    """Upload and read a log."""
    os.environ.update(KEYS)
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        os.environ["AWS_ENDPOINT_URL"] = f"http://{host}:{port}"
        import s3fs

        import mcaprl
        from mcaprl.errors import LogError
        from mcaprl.storage.remote import upload

        system = s3fs.S3FileSystem()
        system.mkdir("logs")
        upload(log, "s3://logs/drives/lane.mcap")
        every = mcaprl.open("s3://logs/drives")
        one = mcaprl.open("s3://logs/drives/lane.mcap", episodes=0)
        try:
            mcaprl.open("s3://logs/none.mcap")
        except LogError as error:
            missing = str(error)
        return {
            "fingerprint": every.fingerprint,
            "episodes": [len(every.episodes), len(one.episodes)],
            "names": sorted(system.find("logs")),
            "missing": missing,
        }
    finally:
        server.stop()


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1])))
