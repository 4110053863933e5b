// The WebSocket to the server: it comes back by itself, and a page that nobody sees asks for little.

const FIRST_WAIT_MS = 300;
const LONGEST_WAIT_MS = 3000;
const HIDDEN_HZ = 1;
const SHOWN_HZ = 60;

export class Link {
  /** `onNews(news)`: what is new. `onState(state, failures)`: "open" or "broken", and how often in a row it has failed. */
  constructor(onNews, onState) {
    this.onNews = onNews;
    this.onState = onState;
    this.failures = 0;
    this.onOpen = () => {};
    document.addEventListener("visibilitychange", () => this.tellPace());
    this.open();
  }

  open() {
    // The token, where there is one, is in this page's own address.
    this.socket = new WebSocket(`ws://${location.host}/live${location.search}`);
    this.socket.onopen = () => {
      this.failures = 0;
      this.onState("open", 0);
      this.onOpen();
      this.tellPace();
    };
    this.socket.onmessage = (event) => this.onNews(JSON.parse(event.data));
    this.socket.onclose = () => {
      this.failures += 1;
      this.onState("broken", this.failures);
      setTimeout(() => this.open(), Math.min(FIRST_WAIT_MS * this.failures, LONGEST_WAIT_MS));
    };
  }

  /** Tell the server what is wished; without a connection it is lost. */
  send(type, fields) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ type, ...fields }));
  }

  tellPace() {
    this.send("pace", { hz: document.hidden ? HIDDEN_HZ : SHOWN_HZ });
  }
}
