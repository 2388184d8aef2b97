"""A robot that explains its plan to a person through the service, while it moves on.

    python examples/service/robot.py http://127.0.0.1:8000

The program needs nothing but Python. Replace ``react`` by the robot's own speech and buttons.
"""

import asyncio
import json
import sys
from urllib.request import Request, urlopen


async def call(url: str, content: dict | None = None) -> dict:
    """Repeats a request until the service answers. The service counts each numbered answer once."""
    body = None if content is None else json.dumps(content).encode()
    request = Request(url, body, {"Content-Type": "application/json"})
    while True:
        try:
            with await asyncio.to_thread(urlopen, request, timeout=5) as got:
                return json.load(got)
        except (TimeoutError, ConnectionError):
            await asyncio.sleep(0.5)


async def react(sentences: list[str], steps: int) -> list[int]:
    """Says the sentences and shows the first steps. Returns the person's labels of these steps."""
    print("robot:", " ".join(sentences) or "(nothing)", f"| steps shown: {steps}")
    return [1] * steps


async def explain(service: str, person: str, trace: list[int]) -> dict:
    """Explains a trace whose second half becomes known only during the explanation."""
    half = len(trace) // 2
    begun = await call(f"{service}/sessions", {"person": person, "trace": trace[:half]})
    session, now = f"{service}/sessions/{begun['id']}", begun["next"]
    while now["kind"] != "wait" or now["step"] < len(trace):
        if now["kind"] == "wait":
            more = {"after": half, "transitions": trace[half:]}
            now = (await call(f"{session}/trace", more))["next"]
        else:
            if now["kind"] == "ask":
                heard = {"answer": (await react([now["text"], now["about"]], 1))[0]}
            else:
                heard = {"labels": await react(now["sentences"], now["step"])}
            heard["number"] = now["number"]
            now = (await call(f"{session}/answers", heard))["next"]
    return await call(session)


async def main(service: str) -> None:
    """Explains the first trace of the service's task to somebody."""
    trace = (await call(f"{service}/task"))["traces"][0]
    print("belief:", (await explain(service, "somebody", trace))["belief"])


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
