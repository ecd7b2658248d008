// Before anything is painted: the theme that was chosen here last, so that no page flashes.
"use strict";
{
  const chosen = (() => {
    try {
      return localStorage.getItem("theme");
    } catch {
      return null; // no storage is allowed here
    }
  })();
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
}
