"use strict";
// Opens the replay of a trial below the table in which its button stands; again closes it.

document.addEventListener("click", (event) => {
  const button = event.target.closest("button[data-replay]");
  if (!button) return;
  const place = button.closest("section").querySelector(".replay-place");
  const open = button.getAttribute("aria-expanded") === "true";
  for (const other of button.closest("section").querySelectorAll("button[data-replay]")) other.setAttribute("aria-expanded", "false");
  place.replaceChildren();
  if (open) return;
  button.setAttribute("aria-expanded", "true");
  const root = document.createElement("div");
  place.append(root);
  mountReplay(root, JSON.parse(document.getElementById(button.dataset.replay).textContent));
  root.scrollIntoView({ block: "nearest" });
});
