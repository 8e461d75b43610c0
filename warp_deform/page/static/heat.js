// Heat maps and goals as translucent layers over picture and table.

const COLORS = {pick: [255, 170, 40], place: [60, 200, 255]};

const canvas = picture => Object.assign(document.createElement("canvas"), {width: picture.width, height: picture.height});

/** A layer in one colour, as opaque as the map is bright. */
export function heatLayer(picture, name) {
  const layer = canvas(picture), c = layer.getContext("2d");
  c.drawImage(picture, 0, 0);
  const image = c.getImageData(0, 0, layer.width, layer.height), [r, g, b] = COLORS[name];
  for (let k = 0; k < image.data.length; k += 4) {
    const share = image.data[k];
    image.data.set([r, g, b, Math.min(255, share * 1.1)], k);
  }
  c.putImageData(image, 0, 0);
  return layer;
}

/** Where a heat map is largest: its column and row. */
export function peak(picture) {
  const c = canvas(picture).getContext("2d");
  c.drawImage(picture, 0, 0);
  const {data, width} = c.getImageData(0, 0, picture.width, picture.height);
  let best = 0;
  for (let k = 0; k < data.length; k += 4) if (data[k] > data[best]) best = k;
  return [best / 4 % width, Math.floor(best / 4 / width)];
}

/** A goal's picture without its background, so that the table shows through. */
export function goalLayer(picture) {
  const layer = canvas(picture), c = layer.getContext("2d");
  c.drawImage(picture, 0, 0);
  const image = c.getImageData(0, 0, layer.width, layer.height), counts = new Map();
  const color = k => image.data[k] << 16 | image.data[k + 1] << 8 | image.data[k + 2];
  for (let k = 0; k < image.data.length; k += 4) counts.set(color(k), (counts.get(color(k)) || 0) + 1);
  const [background] = [...counts].reduce((a, b) => b[1] > a[1] ? b : a);
  for (let k = 0; k < image.data.length; k += 4) image.data[k + 3] = color(k) === background ? 0 : 130;
  c.putImageData(image, 0, 0);
  return layer;
}
