// What probes of the viewer's page begin with: what is asked, the page, what is reported, and the picture as numbers.
const asked = JSON.parse(document.getElementById("asked").textContent);
const app = window.ddprt;
const report = {};
const pixels = () => {
  const image = new Image();
  const canvas = document.createElement("canvas");
  return new Promise((done) => {
    image.onload = () => {
      [canvas.width, canvas.height] = [image.width, image.height];
      canvas.getContext("2d").drawImage(image, 0, 0);
      const { width, height, data } = canvas.getContext("2d").getImageData(0, 0, image.width, image.height);
      done({ width, height, data: Array.from(data) });
    };
    image.src = app.view.screenshot();
  });
};
