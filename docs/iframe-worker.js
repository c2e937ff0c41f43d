// Search works in pages opened from the disk: browsers start no workers there, so that
// the search's own script runs in a hidden frame in place of one.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inside = frame.contentWindow;
      inside.postMessage = (data) =>
        this.dispatchEvent(new MessageEvent("message", { data }));
      inside.importScripts = (...urls) =>
        urls.reduce((before, u) => before.then(() => added(inside, u)), Promise.resolve());
      this.inside = inside;
      this.ready = added(inside, url);
    }

    postMessage(data) {
      this.ready.then(() =>
        this.inside.dispatchEvent(new this.inside.MessageEvent("message", { data })),
      );
    }
  };
  const added = (window_, url) =>
    new Promise((resolve, reject) => {
      const script = window_.document.createElement("script");
      script.src = url;
      script.onload = resolve;
      script.onerror = reject;
      window_.document.head.append(script);
    });
}
