// Elements that stay what they are while their content changes: what is open, has the focus or is being
// clicked is not replaced.

const byId = (id) => document.getElementById(id);

/** Make these the children of an element; those that are in place are not touched. */
function arrange(parent, wanted) {
  const kept = new Set(wanted);
  for (const child of [...parent.childNodes]) if (!kept.has(child)) child.remove();
  let next = parent.firstChild;
  for (const child of wanted) {
    if (child === next) next = next.nextSibling;
    else parent.insertBefore(child, next);
  }
}

/** Elements by a key. */
class KeyedElements {
  /** `create(key)` returns a new element. */
  constructor(create) {
    this.create = create;
    this.elements = new Map();
  }

  /** The element of a key. */
  get(key) {
    if (!this.elements.has(key)) this.elements.set(key, this.create(key));
    return this.elements.get(key);
  }

  /** Forget the elements of all other keys. */
  keep(keys) {
    const kept = new Set(keys);
    for (const key of [...this.elements.keys()]) if (!kept.has(key)) this.elements.delete(key);
  }
}

function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

function element(name, properties = {}) {
  const created = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (key === "role") created.setAttribute(key, value);
    else created[key] = value;
  }
  return created;
}
