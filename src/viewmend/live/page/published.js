// The page of a published performance: a folder of files on any web host. scene.json says what there is; docs/guide/publish.md.

import { Assets } from "./link/assets.js";
import { openPage } from "./page.js";
import { CanvasFilm } from "./published/film.js";
import { Recording } from "./published/recording.js";
import { byId } from "./ui/dom.js";
import { UrlState } from "./view/url_state.js";

const MODES = ["rendered", "holes", "completed", "split"];

/** The address of a file of the performance. @param {string} name */
const fileAddress = (name) => new URL(`../${name}`, import.meta.url);

/** @returns {import("./page.js").Source} */
function publishedSource() {
  const locate = (/** @type {string} */ path) => {
    const [time, camera] = path.split("/");
    return fileAddress(`frames/${time}/${camera ?? "shape"}.bin`).href;
  };
  const recording = new Recording(() => fetch(fileAddress("scene.json")));
  const assets = new Assets(locate, true);
  assets.addEventListener("change", () => {
    if (recording.scene && !assets.usable) recording.fail("Files of this performance are missing or out of reach.");
  });
  byId("picture").addEventListener("framedrawn", () => byId("poster").remove(), { once: true });
  return {
    live: false,
    modes: MODES,
    query: new URLSearchParams(location.hash.slice(1)),
    token: null,
    connection: recording,
    link: recording,
    assets,
    urlState: new UrlState("hash"),
    films: {
      make: (onProgress) => new CanvasFilm(locate, () => recording.scene, onProgress),
      turntable: async (asked) => recording.frame(asked),
    },
    start: () => recording.open(),
  };
}

openPage(publishedSource);
