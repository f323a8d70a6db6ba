// The viewer of a published performance, which is a folder of files on any web host.
// scene.json describes them; see docs/guide/publish.md.

import { Assets } from "./link/assets.js";
import { openPage } from "./page.js";
import { CanvasFilm } from "./published/film.js";
import { Recording } from "./published/recording.js";
import { byId } from "./ui/dom.js";
import { UrlState } from "./view/url_state.js";

/** The modes that the page can draw without a server. */
const MODES = ["rendered", "holes", "completed", "split"];

/** Find the URL of a file of the performance. @param {string} name */
const locateFile = (name) => new URL(`../${name}`, import.meta.url);

/**
 * Find the URL of a shape or of an image. Hosts ignore the version, but browsers then do not take files from
 * their cache that belong to an earlier performance at the same place.
 * @param {string} path "TIME" or "TIME/CAMERA"
 * @param {string} version of the performance
 */
function locateAsset(path, version) {
  const [time, camera] = path.split("/");
  return locateFile(`frames/${time}/${camera ?? "shape"}.bin?v=${version}`).href;
}

/** @returns {import("./page.js").Source} */
function createPublishedSource() {
  const recording = new Recording(() => fetch(locateFile("scene.json"), { cache: "no-cache" }));
  const assets = new Assets(locateAsset, true);
  assets.addEventListener("change", () => {
    if (recording.scene && !assets.usable) {
      recording.fail("Files of this performance are missing or out of reach.");
    }
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
      make: (onProgress) => new CanvasFilm(locateAsset, () => recording.scene, onProgress),
      turntable: async (request) => recording.fitTurntable(request),
    },
    start: () => recording.open(),
  };
}

openPage(createPublishedSource);
