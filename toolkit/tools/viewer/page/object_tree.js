// The objects of the scene graph as a tree: storeys if there are several, rooms, and objects.

class ObjectTree {
  /** `chosen(object)` is called with an object or null, `wanted(object)` to look at one. */
  constructor(parent, chosen, wanted) {
    Object.assign(this, { parent, chosen, wanted });
    this.number = null; // of the chosen object
    this.objects = new Map();
    this.branches = new KeyedElements(() => {
      const details = element("details");
      details.append(element("summary"));
      return details;
    });
    this.buttons = new KeyedElements((number) => this.button(number));
    this.lists = new KeyedElements(() => element("ul", { className: "soft", hidden: true }));
  }

  /** Show these objects. Open branches and the chosen object stay. */
  show(objects, length) {
    this.objects = new Map(objects.map((object) => [object.number, object]));
    this.parent.hidden = !objects.length;
    this.buttons.keep(this.objects.keys());
    this.lists.keep(this.objects.keys());
    const used = [], tops = [];
    for (const [storey, inside] of grouped(objects, (object) => object.storey)) {
      const rooms = grouped(inside, (object) => object.room);
      const branches = [...rooms].map(([room, own]) => {
        const key = JSON.stringify([storey, room]);
        used.push(key);
        const entries = own.flatMap((object) => this.entry(object, length));
        return this.branch(key, room || "no room", own.length, rooms.size === 1, entries);
      });
      const key = JSON.stringify([storey]);
      used.push(key);
      tops.push(...(storey ? [this.branch(key, storey, inside.length, true, branches)] : branches));
    }
    arrange(this.parent, tops);
    this.branches.keep(used);
    this.mark(this.number);
  }

  /** A branch with its children. `open` is how it begins. */
  branch(key, name, count, open, children) {
    const isNew = !this.branches.elements.has(key);
    const details = this.branches.get(key);
    if (isNew) details.open = open;
    const summary = details.firstChild;
    setText(summary, `${name} (${count})`);
    arrange(details, [summary, ...children]);
    return details;
  }

  /** The button of an object, and its size and relations, which are shown while it is chosen. */
  entry({ number, name, corners, relations }, length) {
    const button = this.buttons.get(number), list = this.lists.get(number);
    setText(button, name);
    button.title = name;
    const lines = [`${sizeText(corners)} ${length}`, ...relations];
    arrange(list, lines.map((line, i) => list.children[i] ?? element("li")));
    lines.forEach((line, i) => setText(list.children[i], line));
    return [button, list];
  }

  button(number) {
    const button = element("button", { type: "button" });
    button.onclick = () => {
      this.choose(this.number === number ? null : number);
      if (this.number === number) this.wanted(this.objects.get(number));
    };
    return button;
  }

  /** Choose an object by its number, and show its entry; null for none. */
  choose(number) {
    this.mark(number);
    if (this.number === null) return;
    const button = this.buttons.get(this.number);
    for (let room = button.closest("details"); room; room = room.parentElement.closest("details")) {
      room.open = true;
    }
    this.lists.get(this.number).scrollIntoView({ block: "nearest" });
  }

  /** Mark the chosen object; one that is no longer in the graph is not chosen. */
  mark(number) {
    this.number = this.objects.has(number) ? number : null;
    for (const other of this.objects.keys()) {
      this.buttons.get(other).setAttribute("aria-pressed", other === this.number);
      this.lists.get(other).hidden = other !== this.number;
    }
    this.chosen(this.objects.get(this.number) ?? null);
  }
}

/** The values with the same key, in their order. */
function grouped(values, keyOf) {
  const groups = new Map();
  for (const value of values) {
    const key = keyOf(value);
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(value);
  }
  return groups;
}

/** The lengths of the edges of a box. */
function sizeText(corners) {
  const corner = (number) => corners.slice(3 * number, 3 * number + 3);
  return [1, 2, 4].map((number) => norm(sub(corner(number), corner(0))).toFixed(2)).join(" x ");
}
