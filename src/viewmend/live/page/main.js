// The page of a server: frames, completed views, images and films come from it.

import { Assets } from "./link/assets.js";
import { address } from "./link/address.js";
import { Connection } from "./link/connection.js";
import { decodable } from "./link/pictures.js";
import { ViewerLink } from "./link/viewer.js";
import { openPage } from "./page.js";
import { Film } from "./ui/film.js";
import { MODES } from "./ui/modes.js";
import { UrlState } from "./view/url_state.js";

/** The server that the page came from. @returns {import("./page.js").Source} */
function liveSource() {
  const query = new URLSearchParams(location.search);
  const token = query.get("token");
  const connection = new Connection(token, ["jpeg"]);
  const locate = (/** @type {string} */ path, /** @type {string} */ version, /** @type {string} */ without) => {
    const url = address(`assets/${path}`, token);
    url.searchParams.set("v", version);
    if (without) url.searchParams.set("without", without);
    return url.href;
  };
  return {
    live: true,
    modes: Object.keys(MODES),
    query,
    token,
    connection,
    link: new ViewerLink(connection),
    assets: new Assets(locate),
    urlState: new UrlState("search"),
    films: {
      make: (onProgress) => new Film(token, onProgress),
      async turntable(asked) {
        const url = address("turntable", token);
        for (const [name, value] of Object.entries(asked)) url.searchParams.set(name, String(value));
        const answer = await fetch(url);
        const fitted = await answer.json();
        if (!answer.ok) throw new Error(fitted.error);
        return fitted;
      },
    },
    async start() {
      connection.codecs = await decodable();
      connection.open();
    },
  };
}

openPage(liveSource);
