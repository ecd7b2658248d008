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

// The text node is kept where there is one: thousands of figures change each second.
export const say = (element, text) => {
  const node = element.firstChild;
  if (node?.nodeType === Node.TEXT_NODE && node === element.lastChild) {
    if (node.data !== text) node.data = text;
  } else if (element.textContent !== text) element.textContent = text;
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

// A score: with one decimal, so that a column of them is aligned, or in three significant digits if it is small. One that
// is tiny or huge has an exponent, as in common/printable.py.
export const score = (value) => {
  const size = Math.abs(value ?? 0);
  if (size && (size < 1e-4 || size >= 1e12)) return String(Number(value.toPrecision(4)).toExponential()).replace(/e([+-])(\d)$/, "e$10$2");
  return !size || size >= 0.95 ? number(value) : value.toLocaleString("en", { minimumSignificantDigits: 3, maximumSignificantDigits: 3 });
};

export const short = (seconds) => (seconds < 10 ? seconds.toPrecision(2) : number(seconds, 0));

// A moment, with its day where they span more than one.
export const clock = (moment, span = 0) => {
  const day = { year: "numeric", month: "2-digit", day: "2-digit" };
  const time = { hour: "2-digit", minute: "2-digit", second: "2-digit" };
  return new Date(moment * 1000).toLocaleString("en-GB", { ...(span > 43200 && day), ...time });
};

export const tiles = (list, rows) =>
  fill(
    list,
    rows,
    () => {
      const whole = make("div", "", { class: "tile" });
      whole.append(make("span"), make("b"), make("span"));
      return whole;
    },
    (each, row) => {
      say(each.children[0], row.name);
      say(each.children[1], row.value);
      say(each.children[2], row.beneath);
      each.classList.toggle("none", row.value === "-");
    },
  );

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

export const ask = async (path) => {
  const answer = await fetch(path, { headers: { accept: "application/json" } });
  const document = await answer.json().catch(() => ({ error: `the dashboard answered ${answer.status}` }));
  if (!answer.ok) throw new Error(document.error ?? `the dashboard answered ${answer.status}`);
  return document;
};

export const runLink = (name) => `#/run/${encodeURIComponent(name)}`;
export const liveLink = (name) => `#/live/${encodeURIComponent(name)}`;

let turn = 0; // an answer that comes after another page was opened is nobody's

export const leave = () => {
  turn += 1;
};

const failed = (error) => {
  const card = make("section", "", { class: "card full empty" });
  card.append(make("h1", "This cannot be shown"), make("p", error.message), make("a", "All runs", { href: "#/runs" }));
  document.getElementById("main").replaceChildren(card);
};

// A page that is filled with answers: it says that it waits, and what went wrong; `current` is whether it is still open.
export const guarded = (work) => async (...words) => {
  turn += 1;
  const mine = turn;
  const current = () => mine === turn;
  document.getElementById("main").replaceChildren(make("p", "Loading…", { class: "muted loading", role: "status" }));
  try {
    await work(current, ...words);
  } catch (error) {
    if (current()) failed(error);
  }
};
