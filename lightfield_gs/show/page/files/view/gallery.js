// The strip of pictures: those of the folder, and those that are dropped or chosen.

import { answerOf, element, find, post } from "./dom.js";

const MOST_FILES = 500; // of one drop

export class Gallery {
  /** opened(): shows the picture that the program has opened by now. */
  constructor(state, told, opened) {
    Object.assign(this, { state, told, opened, isBusy: false, suffixes: [] });
    find("#strip").hidden = false;
    this.listen();
  }

  async read() {
    this.show(await (await answerOf("gallery.json")).json());
  }

  show({ items, shown, suffixes }) {
    this.suffixes = suffixes;
    const list = find("#items"), same = list.children.length;
    for (const [place, item] of items.entries()) if (place >= same) list.append(this.tile(item, place));
    for (const [place, { firstChild: button }] of [...list.children].entries()) button.setAttribute("aria-current", place === shown);
    list.children[shown].scrollIntoView({ block: "nearest", inline: "nearest" });
  }

  tile({ name, is_scene }, place) {
    const kind = () => element("i", { textContent: name.split(".").pop().toUpperCase(), ariaHidden: "true" });
    const picture = is_scene ? kind() : element("img", { src: `thumbnail?item=${place}`, alt: "", loading: "lazy", decoding: "async" });
    picture.addEventListener?.("error", () => picture.replaceWith(kind()));
    const button = element("button", { title: name }, picture, element("span", { textContent: name }));
    button.addEventListener("click", () => this.open(place, name));
    return element("li", {}, button);
  }

  async open(place, name) {
    await this.while(`Opening ${name}…`, async () => {
      const answer = await post("open", this.state.scene.token, { item: place });
      this.show(await answer.json());
      await this.opened();
    }, "Not opened", "The terminal says what helps.");
  }

  /** Does something that takes a while, and says so over the picture. */
  async while(words, work, failed, advice = "") {
    if (this.isBusy) return;
    this.isBusy = true;
    this.say(words);
    try {
      await work();
    } catch (error) {
      this.told.say(`${failed}: ${error.message.split("; ")[0]}. ${advice}`);
    } finally {
      this.isBusy = false;
      this.say("");
    }
  }

  say(words) {
    find("#opening").hidden = !words;
    find("#opening").textContent = words;
  }

  /** Hands files to the program, and shows the first photo or scene of them. */
  async take(files) {
    const wanted = files.filter(({ name }) => !name.startsWith(".") && this.suffixes.some((suffix) => name.toLowerCase().endsWith(suffix)));
    const left = files.length - wanted.length, { token } = this.state.scene, drop = Date.now();
    if (!wanted.length) return this.told.say("None of these files is a photo or a scene.");
    if (wanted.length > MOST_FILES) return this.told.say(`These are ${wanted.length} files: at most ${MOST_FILES} are taken at once.`);
    let shown = null;
    await this.while("Taking the files…", async () => {
      for (const [number, file] of wanted.entries()) {
        this.say(`Taking ${file.name}${wanted.length > 1 ? `, ${number + 1} of ${wanted.length}` : ""}…`);
        await answerOf(`drop?${new URLSearchParams({ drop, name: file.name })}`, undefined, { method: "POST", headers: { "X-Token": token }, body: file });
      }
      const found = await (await post("dropped", token, { drop })).json();
      this.show(found);
      shown = found.first;
    }, "The files cannot be taken");
    if (shown === null) return;
    await this.open(shown, find("#items").children[shown].innerText);
    if (left) this.told.say(`${left} of the files ${left === 1 ? "is" : "are"} neither photo nor scene, and left out.`);
  }

  listen() {
    let depth = 0;
    const over = (by) => { depth = Math.max(0, depth + by); find("#drop").hidden = depth === 0; };
    addEventListener("dragenter", (event) => { if (event.dataTransfer?.types.includes("Files")) over(1); });
    addEventListener("dragleave", (event) => { if (event.dataTransfer?.types.includes("Files")) over(-1); });
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", async (event) => {
      event.preventDefault();
      depth = 0;
      over(0);
      const files = await filesOf(event.dataTransfer);
      if (files.length) this.take(files);
    });
    for (const [button, input] of [["#open-files", "#files"], ["#open-folder", "#folder"]]) {
      find(button).addEventListener("click", () => find(input).click());
      find(input).addEventListener("change", () => {
        this.take([...find(input).files]);
        find(input).value = "";
      });
    }
  }
}

/** The files of a drop, and those in its folders. */
async function filesOf({ items, files }) {
  const entries = [...items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return [...files];
  return (await Promise.all(entries.map(filesBelow))).flat();
}

async function filesBelow(entry) {
  if (entry.isFile) return [await new Promise((done, failed) => entry.file(done, failed))];
  const reader = entry.createReader(), found = [];
  for (;;) { // a folder tells of 100 at a time
    const some = await new Promise((done, failed) => reader.readEntries(done, failed));
    if (!some.length) return (await Promise.all(found.map(filesBelow))).flat();
    found.push(...some);
  }
}
