// Search runs in a worker, which browsers refuse to pages read from the disk: there a hidden frame does the work.
if (location.protocol === "file:") {
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(script) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      frame.answer = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      this.frame = new Promise((ready) => frame.addEventListener("load", () => ready(frame), { once: true }));
      frame.srcdoc = `<script>postMessage = (data) => frameElement.answer(data)</script><script src="${script}"></script>`;
      document.body.append(frame);
    }

    postMessage(data) {
      this.frame.then(({ contentWindow }) =>
        contentWindow.dispatchEvent(new contentWindow.MessageEvent("message", { data })));
    }

    terminate() {
      this.frame.then((frame) => frame.remove());
    }
  };
}
