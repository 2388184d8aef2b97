"""The service: a program asks which messages come next, and sends the person's labels."""

import json
from urllib.request import Request, urlopen


def call(path, **content):
    body = json.dumps(content).encode() if content else None
    headers = {"Content-Type": "application/json"}
    with urlopen(Request(f"http://127.0.0.1:8000/{path}", body, headers)) as reply:
        return json.load(reply)


trace = call("task")["traces"][0]
talk = call("sessions", person="p1", trace=trace)
while (now := talk["next"])["kind"] == "explain":
    print(now["step"], now["sentences"])
    talk = call(f"sessions/{talk['id']}/answers", number=now["number"], labels=[1] * now["step"])
