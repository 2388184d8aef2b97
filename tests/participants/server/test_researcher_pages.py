"""The researcher's page: nothing without the key."""

from __future__ import annotations

import re

from flask.testing import FlaskClient

from tests.participants.visitors import field
from xplain.participants.server.security import Keys
from xplain.participants.server.store import Store


def test_the_researchers_page_needs_its_key(store: Store, client: FlaskClient) -> None:
    assert "Who is where" not in client.get("/researcher").text
    for path in ("/researcher/invitations", "/researcher/export"):
        assert client.post(path, data={"count": "1", "stream": "bot"}).status_code == 403
    assert client.post("/researcher/login", data={"key": "guess"}).status_code == 403
    keys = Keys(store.secret)
    done = client.post("/researcher/login", data={"key": keys.researcher})
    assert done.status_code == 303
    assert "SameSite=Strict" in done.headers["Set-Cookie"]
    html = client.get("/researcher").text
    assert "Who is where" in html
    token = field(html, "token")
    good = {"token": token, "count": "3", "stream": "pilot"}
    for bad in ({"count": "0"}, {"count": "501"}, {"count": "x"}, {"stream": "king"}):
        assert client.post("/researcher/invitations", data=good | bad).status_code == 400
    assert client.post("/researcher/invitations", data=good | {"token": ""}).status_code == 403
    html = client.post("/researcher/invitations", data=good).text
    tokens = re.findall(r"\?invitation=([\w-]+)", html)
    assert len(tokens) == 3
    assert store.participant(store.enter_invited(tokens[0])).stream == "pilot"
    archive = client.post("/researcher/export", data={"token": token})
    assert archive.data[:2] == b"PK"
