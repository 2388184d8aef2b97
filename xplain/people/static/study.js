"use strict";
// Sends answers from an outbox, which survives a lost network, a reload and a restart of the
// server. Sends the page's own events (seen, hidden, clicked) in the background. The forms also
// work without JavaScript.
(() => {
  const body = document.body;
  // Updates the overview on the researcher's page. The fields above it keep their content.
  const glance = document.getElementById("glance");
  if (glance) setInterval(async () => {
    try {
      const reply = await fetch(location.href, { credentials: "same-origin" });
      const page = new DOMParser().parseFromString(await reply.text(), "text/html");
      if (reply.ok && page.getElementById("glance")) glance.replaceChildren(...page.getElementById("glance").childNodes);
    } catch { /* no reply; try again next time */ }
  }, 10000);
  if (!("sequence" in body.dataset)) return;
  const { token, sequence, mark, events: address } = body.dataset;
  const connection = document.getElementById("connection");
  const OUTBOX = "study-outbox-" + token.slice(0, 16);

  // Answers ---------------------------------------------------------------------------------
  let leaving = false;
  const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  const kept = () => { try { return JSON.parse(localStorage.getItem(OUTBOX)); } catch { return null; } };
  const keep = (item) => {
    try { item ? localStorage.setItem(OUTBOX, JSON.stringify(item)) : localStorage.removeItem(OUTBOX); } catch { /* private mode: the page itself still retries */ }
  };

  // A reply with the server's mark accepts or refuses the answer. Other replies come from a proxy,
  // or from a server with an error: the answer is sent again.
  const acknowledges = (reply) => reply.headers.get("Study-Mark") === mark;
  async function deliver(item) {
    for (let pause = 500; ; pause = Math.min(pause * 2, 8000)) {
      try {
        const reply = await fetch(item.action, {
          method: "POST", body: new URLSearchParams(item.fields), credentials: "same-origin",
          redirect: "manual", headers: { "Study-Script": "1" },
        });
        if (acknowledges(reply)) return reply;
      } catch { /* no network; try again */ }
      connection.textContent = body.dataset.lost;
      note("retry", String(item.sequence));
      await wait(pause);
    }
  }

  async function send(item) {
    keep(item);
    const reply = await deliver(item);
    keep(null);
    connection.textContent = "";
    leaving = true;
    if (reply.status === 204) {
      location.replace(item.action);
    } else {
      // The same page, with a sentence about the refused answer.
      const page = new DOMParser().parseFromString(await reply.text(), "text/html");
      document.querySelector("main").replaceWith(page.querySelector("main"));
      document.querySelector("main").focus();
      for (const button of document.querySelectorAll("button")) button.disabled = false;
      leaving = false;
    }
  }

  document.addEventListener("submit", (event) => {
    const form = event.target;
    const action = form.getAttribute("action");
    if (!action || form.getAttribute("method") !== "post") return;
    event.preventDefault();
    if (leaving) return;
    leaving = true;
    for (const button of document.querySelectorAll("button")) button.disabled = true;
    if (form.elements.ms) form.elements.ms.value = performance.now().toFixed(1);
    if (form.elements.width) form.elements.width.value = String(window.innerWidth);
    form.querySelector("button").after(connection); // where the participant looks
    flush();
    const fields = [...new FormData(form)].map(([name, value]) => [name, String(value)]);
    send({ action, fields, sequence: Number(sequence) });
  });

  window.addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });

  // Screen readers announce changes of a page, but not the content of a new page.
  const announce = document.getElementById("announce");
  const fresh = [...document.querySelectorAll(".message.new")].map((m) => m.textContent.trim());
  if (announce && fresh.length) setTimeout(() => { announce.textContent = fresh.join(" "); }, 400);

  // Events of the page ------------------------------------------------------------------------
  const tab = [...crypto.getRandomValues(new Uint8Array(8))].map((b) => b.toString(16).padStart(2, "0")).join("");
  let number = 0;
  let queue = [];
  let busy = false;

  function note(kind, what = "") {
    const ms = performance.now();
    queue.push({ n: number++, kind, ms, at: Date.now(), what });
  }

  // A beacon is sent even after the page is closed. A fetch shows that the server stored the events.
  function flush() {
    if (queue.length) {
      const text = JSON.stringify({ token, tab, items: queue.slice(-50) });
      if (navigator.sendBeacon(address, new Blob([text], { type: "application/json" })) && leaving) queue = [];
    }
  }

  async function deliverEvents() {
    if (busy || leaving || !queue.length) return;
    busy = true;
    const items = queue.slice(0, 50);
    try {
      const reply = await fetch(address, { method: "POST", body: JSON.stringify({ token, tab, items }), credentials: "same-origin" });
      if (acknowledges(reply)) queue = queue.slice(items.length);
    } catch { /* the events stay in the queue */ }
    busy = false;
  }

  note(document.hidden ? "hidden" : "visible", body.dataset.stage);
  document.addEventListener("visibilitychange", () => {
    if (leaving) return;
    note(document.hidden ? "hidden" : "visible", body.dataset.stage);
    if (document.hidden) flush();
  });
  window.addEventListener("pagehide", () => { if (!leaving) { note("hidden", "closed"); flush(); } });
  document.addEventListener("change", (event) => {
    if (event.target.type === "radio" || event.target.type === "checkbox") note("label", (event.target.name + "=" + event.target.value).slice(0, 40));
  });
  // Typing and scrolling show that the participant is active.
  let active = 0;
  for (const kind of ["input", "scroll", "pointerdown", "keydown"]) document.addEventListener(kind, () => {
    if (leaving || performance.now() < active + 20000) return;
    active = performance.now();
    note("active");
  }, { passive: true });
  for (const details of document.querySelectorAll("details.recall")) {
    details.addEventListener("toggle", () => note("recall", details.open ? "open" : "closed"));
  }
  setInterval(deliverEvents, 4000);
  deliverEvents();
  const left = kept();
  if (left) send(left);
})();
