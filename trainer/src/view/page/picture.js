// Asks for pictures, one at a time, and shows them.
//
// While something moves, the size adapts so that rendering takes about TARGET_MS; once all is still, the picture is
// taken again at full size. Only a changed size or camera costs a whole picture: edits at rest draw what they change.

const TARGET_MS = 45;      // of rendering: leaves room for the browser's own work at 15 pictures a second
const REST_MS = 220;       // how long nothing moves before the full size is worth it
const SLOT = { after: 0, before: 1, moving: 2, movingBefore: 3 };

export class Picture {
  constructor(canvas, info, state, show) {
    Object.assign(this, { canvas, info, state, show });
    this.context = canvas.getContext("2d");
    this.scale = { turn: 0.5, edit: 1 };
    this.kept = {};          // side → {signature, image}
    this.busy = false;
    this.dirty = true;
    this.moved = { turn: 0, edit: 0 };
    this.times = [];
    this.pictures = 0;
    this.settled = "";
    this.loop = this.loop.bind(this);
    requestAnimationFrame(this.loop);
  }

  // `how` is "turn" (the camera moves) or "edit" (the face moves); none asks for one full picture.
  change(how) {
    this.dirty = true;
    if (how) this.moved[how] = performance.now();
  }

  moving() {
    const now = performance.now();
    if (now - this.moved.turn < REST_MS) return "turn";
    if (now - this.moved.edit < REST_MS) return "edit";
    return null;
  }

  async loop() {
    requestAnimationFrame(this.loop);
    const moving = this.moving();
    // At rest, a picture that was taken small is taken once more.
    if (this.wasMoving && !moving) this.dirty = true;
    if (this.busy || !this.dirty) return;
    this.wasMoving = !!moving;
    this.dirty = false;
    this.busy = true;
    try {
      await this.draw(moving);
      this.show.trouble("");
    } catch (error) {
      this.show.trouble(`No picture: ${error.message}. Is trainer view still running?`);
      await new Promise((done) => setTimeout(done, 1000));
      this.dirty = true;
    } finally {
      this.busy = false;
    }
  }

  async draw(moving) {
    const began = performance.now();
    const scale = moving ? this.scale[moving] : 1;
    const small = scale < 1;
    const after = await this.side("after", small ? SLOT.moving : SLOT.after, this.state.aus, scale);
    const before = this.state.compare ? await this.side("before", small ? SLOT.movingBefore : SLOT.before, this.state.before, scale) : null;
    this.paint(after.image, before && before.image);
    if (moving) this.adapt(moving, after.millis + (before ? before.millis : 0));
    this.measure(began, after);
    this.settled = moving ? "" : after.signature;
  }

  async side(name, slot, aus, scale) {
    const request = { orbit: this.state.orbit, aus, scale: Math.round(scale * 32) / 32, overlay: this.state.overlay, slot, jpeg: this.state.jpeg };
    // The live face's AUs are those of the moment: such a picture is never one that is kept.
    const live = name === "after" && this.state.live;
    if (live) Object.assign(request, { live: true, live_head: this.state.liveHead });
    const signature = JSON.stringify(request);
    if (!live && this.kept[name]?.signature === signature) return this.kept[name];
    const answer = await fetch("frame", { method: "POST", body: signature });
    if (!answer.ok) throw new Error(await answer.text());
    const [width, height, millis] = ["X-Width", "X-Height", "X-Millis"].map((n) => Number(answer.headers.get(n)));
    const image = request.jpeg ? await createImageBitmap(await answer.blob()) : fromRgb(new Uint8Array(await answer.arrayBuffer()), width, height);
    this.pictures += 1;
    if (live) this.show.live(JSON.parse(answer.headers.get("X-Live") ?? "null"));
    return (this.kept[name] = { signature, image, width, height, millis });
  }

  paint(after, before) {
    const { width, height } = after;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const put = (image, x, w) => {
      if (w <= 0) return;
      if (image instanceof ImageData) this.context.putImageData(image, 0, 0, x, 0, w, height);
      else this.context.drawImage(image, x, 0, w, height, x, 0, w, height);
    };
    const cut = before ? Math.round(this.state.divider * width) : 0;
    if (before) put(before, 0, cut);
    put(after, cut, width - cut);
  }

  // Repaints what is there, for a moved divider.
  repaint() {
    if (this.kept.after) this.paint(this.kept.after.image, this.state.compare && this.kept.before?.image);
  }

  adapt(moving, took) {
    // The first edit after a turn pays for a whole picture and says nothing of the next.
    if (moving === "edit" && this.last !== "edit") { this.last = moving; return; }
    this.last = moving;
    const factor = Math.sqrt(TARGET_MS / Math.max(took, 1));
    // A new size means a whole new picture: small differences are not worth it.
    if (factor > 0.85 && factor < 1.3) return;
    const wanted = this.scale[moving] * Math.min(1.25, Math.max(0.6, factor));
    this.scale[moving] = Math.min(1, Math.max(0.3, wanted));
  }

  measure(began, picture) {
    const now = performance.now();
    if (!this.times.length || began - this.times[this.times.length - 1] > 400) this.times = [began];
    this.times.push(now);
    clearTimeout(this.resting);
    this.resting = setTimeout(() => this.show.rest(), 1000);
    while (this.times.length > 2 && now - this.times[0] > 1000) this.times.shift();
    this.show.meter((1000 * (this.times.length - 1)) / (now - this.times[0]), picture);
  }
}

function fromRgb(rgb, width, height) {
  const image = new ImageData(width, height);
  const out = new Uint32Array(image.data.buffer);
  for (let i = 0, j = 0; i < out.length; i += 1, j += 3) out[i] = 0xff000000 | (rgb[j + 2] << 16) | (rgb[j + 1] << 8) | rgb[j];
  return image;
}
