// The viewer of a live server, which provides frames, completed views, images and videos.

import { Assets } from "./link/assets.js";
import { buildAddress } from "./link/address.js";
import { Connection } from "./link/connection.js";
import { findDecodableCodecs } from "./link/pictures.js";
import { ViewerLink } from "./link/viewer.js";
import { openPage } from "./page.js";
import { Film } from "./ui/film.js";
import { MODES } from "./ui/modes.js";
import { UrlState } from "./view/url_state.js";

/** Use the server that the page came from. @returns {import("./page.js").Source} */
function createLiveSource() {
  const query = new URLSearchParams(location.search);
  const token = query.get("token");
  const connection = new Connection(token, ["jpeg"]);
  return {
    live: true,
    modes: Object.keys(MODES),
    query,
    token,
    connection,
    link: new ViewerLink(connection),
    assets: new Assets((path, version, without) => locateAsset(path, version, without, token)),
    urlState: new UrlState("search"),
    films: {
      make: (onProgress) => new Film(token, onProgress),
      turntable: (request) => fetchTurntable(request, token),
    },
    async start() {
      connection.codecs = await findDecodableCodecs();
      connection.open();
    },
  };
}

/**
 * @param {string} path
 * @param {string} version of the assets
 * @param {string} without names of cameras that are not used, separated by commas
 * @param {string | null} token
 */
function locateAsset(path, version, without, token) {
  const url = buildAddress(`assets/${path}`, token);
  url.searchParams.set("v", version);
  if (without) url.searchParams.set("without", without);
  return url.href;
}

/**
 * Let the server fit a turntable to the whole motion.
 * @param {Record<string, number>} request
 * @param {string | null} token
 */
async function fetchTurntable(request, token) {
  const url = buildAddress("turntable", token);
  for (const [name, value] of Object.entries(request)) url.searchParams.set(name, String(value));
  const response = await fetch(url);
  const fitted = await response.json();
  if (!response.ok) throw new Error(fitted.error);
  return fitted;
}

openPage(createLiveSource);
