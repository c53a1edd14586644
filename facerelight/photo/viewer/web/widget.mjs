// The viewer's page in a notebook's cell: what is changed in it goes to Python, and what Python says is shown.

const WAIT = 100; // milliseconds

export function render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.title = "The light";
  Object.assign(frame.style, { width: "100%", height: `${model.get("height")}px`, border: "0" });
  frame.srcdoc = model.get("page");
  let known = "", timer = 0;
  const page = () => frame.contentWindow && frame.contentWindow.facerelight;
  const shown = (scene) => {
    const said = JSON.stringify(scene);
    if (!page() || said === known) return;
    known = said;
    page().set(scene);
  };
  const tell = () => {
    const scene = page().scene, said = JSON.stringify(scene);
    if (said === known) return;
    known = said;
    model.set("scene", scene);
    model.save_changes();
  };
  const heard = () => shown(model.get("scene"));
  const begin = () => {
    if (!page()) {
      timer = setTimeout(begin, WAIT); // the page unpacks what it has to know
      return;
    }
    heard();
    frame.contentWindow.addEventListener("lightchange", tell);
  };
  model.on("change:scene", heard);
  frame.addEventListener("load", begin);
  el.appendChild(frame);
  return () => {
    clearTimeout(timer);
    model.off("change:scene", heard);
  };
}

export default { render };
