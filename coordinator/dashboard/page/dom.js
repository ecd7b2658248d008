// Small helpers. Whatever comes from elsewhere is set as text, never as markup.

export const parts = (root) => {
  const found = {};
  for (const each of root.querySelectorAll("[data-part]")) found[each.dataset.part] = each;
  return found;
};

export const open = (name) => {
  const root = document.getElementById("main");
  root.replaceChildren(document.getElementById(name).content.cloneNode(true));
  return parts(root);
};

export const say = (element, text) => {
  if (element.textContent !== text) element.textContent = text;
};

export const make = (tag, text = "", attributes = {}) => {
  const element = document.createElement(tag);
  if (text !== "") element.textContent = text;
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
};

// As many children as there are rows, made where they are missing; what is there is kept and only filled anew.
export const fill = (parent, rows, create, update) => {
  while (parent.children.length > rows.length) parent.lastElementChild.remove();
  rows.forEach((row, index) => {
    let child = parent.children[index];
    if (!child) {
      child = create();
      parent.append(child);
    }
    update(child, row, index);
  });
};

export const facts = (list, rows) => {
  fill(
    list,
    rows,
    () => {
      const row = make("div");
      row.append(make("dt"), make("dd"));
      return row;
    },
    (row, [name, value]) => {
      say(row.children[0], name);
      say(row.children[1], value);
    },
  );
};

export const number = (value, digits = 1) =>
  value === null || value === undefined
    ? "-"
    : value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

export const ask = async (path) => {
  const answer = await fetch(path, { headers: { accept: "application/json" } });
  const document = await answer.json().catch(() => ({ error: `the dashboard answered ${answer.status}` }));
  if (!answer.ok) throw new Error(document.error ?? `the dashboard answered ${answer.status}`);
  return document;
};

export const runLink = (name) => `#/run/${encodeURIComponent(name)}`;
