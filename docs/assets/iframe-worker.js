/* Browsers start no worker from a file:// page; the search of the site then runs in a hidden frame. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.url = new URL(url, location.href).href
      this.waiting = []
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.appendChild(frame)
      const inner = frame.contentWindow
      this.inner = inner
      inner.postMessage = (data) => setTimeout(() => this.report(data))
      inner.importScripts = (...urls) =>
        urls.reduce((done, one) => done.then(() => this.load(new URL(one, this.url).href)), Promise.resolve())
      this.load(this.url).then(() => {
        this.inner.__ready = true
        this.waiting.splice(0).forEach((data) => this.postMessage(data))
      })
    }
    load(url) {
      return new Promise((resolve, reject) => {
        const script = this.inner.document.createElement("script")
        script.src = url
        script.onload = resolve
        script.onerror = () => reject(new Error(`${url} cannot be loaded`))
        this.inner.document.body.appendChild(script)
      })
    }
    report(data) {
      const event = new MessageEvent("message", { data })
      this.dispatchEvent(event)
      if (this.onmessage) this.onmessage(event)
    }
    postMessage(data) {
      if (!this.inner.__ready) return void this.waiting.push(data)
      const event = new MessageEvent("message", { data })
      this.inner.dispatchEvent(event)
      if (this.inner.onmessage) this.inner.onmessage(event)
    }
    terminate() {}
  }
}
