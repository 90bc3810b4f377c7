"use strict";
const flight=JSON.parse(document.getElementById("flight").textContent),charts=[],tip=document.getElementById("tip");
const whole=Math.max(flight.seconds,1);let from=0,to=whole;
const clock=s=>{const sign=s<0?"-":"";s=Math.abs(s);const m=Math.floor(s/60+1e-9),r=s-60*m;return sign+m+":"+(to-from<20?r.toFixed(1).padStart(4,"0"):String(Math.floor(r+1e-6)).padStart(2,"0"))};
function make(tag,text,parent){const e=document.createElement(tag);if(text)e.textContent=text;if(parent)parent.append(e);return e}
for(const chart of flight.charts){
 const box=make("section","",document.getElementById("charts"));make("h2",chart.title,box);
 if(chart.about)make("small",chart.about,box);
 const canvas=make("canvas","",box),key=make("div","",box);key.className="key";
 for(const [name,colour,kind] of chart.key){const one=make("span","",key),i=make("i","",one);i.style.background=colour;if(kind)i.className=kind;one.append(name)}
 charts.push({chart,canvas,left:0});listen(charts[charts.length-1]);
}
const nice=span=>{const p=10**Math.floor(Math.log10(span));for(const k of[1,2,5,10])if(span/(k*p)<=6)return k*p;return 10*p};
function steps(){for(const s of[.1,.2,.5,1,2,5,10,15,30,60,120,300,600,1200,3600])if((to-from)/s<=(innerWidth<600?5:10))return s;return 7200}
function draw(){
 document.getElementById("range").textContent=clock(from)+" – "+clock(to);
 for(const one of charts)one.chart.rows?bars(one):lines(one);
}
function begin(one,height,left){
 const c=one.canvas,dpr=devicePixelRatio||1,w=c.clientWidth;c.style.height=height+"px";c.width=w*dpr;c.height=height*dpr;
 const g=c.getContext("2d");g.scale(dpr,dpr);g.font="12px system-ui,sans-serif";g.clearRect(0,0,w,height);
 one.left=left;one.width=w-left-6;one.height=height;one.x=t=>left+(t-from)/(to-from)*one.width;
 g.fillStyle="#93a1ae";g.textAlign="center";g.strokeStyle="#2a333c";const s=steps();
 for(let t=Math.ceil(from/s)*s;t<=to+1e-9;t+=s){const x=one.x(t);g.beginPath();g.moveTo(x,0);g.lineTo(x,height-16);g.stroke();if(x>left+12&&x<w-14)g.fillText(clock(t),x,height-3)}
 return g}
function clip(g,one){g.save();g.beginPath();g.rect(one.left,0,one.width,one.height-16);g.clip()}
function bars(one){
 const rows=one.chart.rows,h=20,narrow=innerWidth<600,left=narrow?92:210,g=begin(one,rows.length*h+20,left);
 rows.forEach((row,k)=>{g.textAlign="right";g.fillStyle="#e8edf2";g.fillText(fit(g,narrow&&row.short?row.short:row.name,left-8),left-6,k*h+14)});
 clip(g,one);
 rows.forEach((row,k)=>{for(const [a,b,colour] of row.spans){if(b<from||a>to)continue;g.fillStyle=colour;const x=one.x(a);g.fillRect(x,k*h+3,Math.max(one.x(b)-x,1),h-5)}});
 g.restore();
 one.at=(t,y)=>{const row=rows[Math.floor(y/h)];if(!row)return"";const slack=2/one.width*(to-from);const hit=row.spans.find(s=>s[0]-slack<=t&&t<=s[1]+slack);return row.name+": "+(hit?hit[3]:"nothing known")+" at "+clock(t)}}
function fit(g,text,width){while(text.length>3&&g.measureText(text).width>width)text=text.slice(0,-2)+"…";return text}
function lines(one){
 const height=170,g=begin(one,height,innerWidth<600?40:52),all=one.chart.series;let low=one.chart.low,high=one.chart.high,seen=[];
 for(const s of all)for(let k=0;k<s.t.length;k++)if(s.t[k]>=from&&s.t[k]<=to&&s.y[k]!==null)seen.push(s.y[k]);
 seen.sort((a,b)=>a-b);const q=p=>seen.length?seen[Math.min(seen.length-1,Math.floor(p*seen.length))]:0;
 if(low===null||low===undefined)low=q(.002);if(high===null||high===undefined)high=q(.998);if(high-low<1e-9){high+=1;if(one.chart.low!==0)low-=1}for(const m of one.chart.marks||[]){high=Math.max(high,m);low=Math.min(low,m)}const pad=.06*(high-low);high+=pad;if(one.chart.low!==0)low-=pad;
 const bottom=height-18,y=v=>bottom-(v-low)/(high-low)*(bottom-6),s=nice(high-low);
 g.textAlign="right";for(let v=Math.ceil(low/s)*s;v<=high;v+=s){g.strokeStyle="#2a333c";g.beginPath();g.moveTo(one.left,y(v));g.lineTo(one.left+one.width,y(v));g.stroke();g.fillStyle="#93a1ae";g.fillText(+v.toPrecision(6)+"",one.left-5,y(v)+4)}
 clip(g,one);
 for(const m of one.chart.marks||[]){g.strokeStyle="#f4b74099";g.setLineDash([5,4]);g.beginPath();g.moveTo(one.left,y(m));g.lineTo(one.left+one.width,y(m));g.stroke();g.setLineDash([])}
 for(const s of all){
  if(s.band){g.fillStyle=s.colour+"2e";let run=[];const flush=()=>{if(run.length>1){g.beginPath();run.forEach((k,i)=>g[i?"lineTo":"moveTo"](one.x(s.t[k]),y(s.y[k]+s.band[k])));run.reverse().forEach(k=>g.lineTo(one.x(s.t[k]),y(s.y[k]-s.band[k])));g.fill()}run=[]};for(let k=0;k<s.t.length;k++){if(s.y[k]===null||s.band[k]===null)flush();else run.push(k)}flush()}
  g.strokeStyle=s.colour;g.lineWidth=s.dash?1:1.6;g.setLineDash(s.dash||[]);g.beginPath();let pen=false;
  for(let k=0;k<s.t.length;k++){if(s.y[k]===null){pen=false;continue}g[pen?"lineTo":"moveTo"](one.x(s.t[k]),y(s.y[k]));if(!pen)g.lineTo(one.x(s.t[k])+.5,y(s.y[k]));pen=true}
  g.stroke();g.setLineDash([]);g.lineWidth=1}
 g.restore();
 if(!seen.length){g.fillStyle="#93a1ae";g.textAlign="center";g.fillText("nothing in this range",one.left+one.width/2,bottom/2)}
 one.at=t=>{const out=[];for(const s of all){if(s.dash&&all.length>6)continue;let k=near(s.t,t);if(k>=0&&Math.abs(s.t[k]-t)<Math.max((to-from)/60,1)&&s.y[k]!==null)out.push(s.name+" "+(+s.y[k].toPrecision(4)))}return clock(t)+(out.length?": "+out.join(", "):"")+(one.chart.unit?" "+one.chart.unit:"")}}
function near(t,x){let a=0,b=t.length;if(!b)return-1;while(a<b){const m=a+b>>1;t[m]<x?a=m+1:b=m}return a>0&&(a>=t.length||x-t[a-1]<t[a]-x)?a-1:a}
let due=false;function later(){if(!due){due=true;requestAnimationFrame(()=>{due=false;draw()})}}
function show(a,b){let span=Math.min(Math.max(b-a,.5),whole);a=Math.min(Math.max(a,0),whole-span);from=a;to=a+span;later()}
function listen(one){
 const c=one.canvas,time=e=>from+(e.clientX-c.getBoundingClientRect().left-one.left)/one.width*(to-from),held=new Map();
 c.addEventListener("wheel",e=>{if(!e.ctrlKey&&Math.abs(e.deltaX)<=Math.abs(e.deltaY))return;e.preventDefault();if(!e.ctrlKey){const d=e.deltaX/one.width*(to-from);return show(from+d,to+d)}const t=time(e),k=Math.exp((e.deltaMode?.05:.0016)*e.deltaY);show(t-(t-from)*k,t+(to-t)*k)},{passive:false});
 c.addEventListener("pointerdown",e=>{c.setPointerCapture(e.pointerId);held.set(e.pointerId,time(e))});
 c.addEventListener("pointermove",e=>{
  if(!held.size){tip.textContent=one.at?one.at(time(e),e.clientY-c.getBoundingClientRect().top):"";tip.style.display=tip.textContent?"block":"none";tip.style.left=Math.max(4,Math.min(e.clientX+14,innerWidth-tip.offsetWidth-6))+"px";tip.style.top=Math.max(4,e.clientY-tip.offsetHeight-12)+"px";return}
  if(!held.has(e.pointerId))return;
  if(held.size===1){const d=held.get(e.pointerId)-time(e);show(from+d,to+d)}
  else{const [p,q]=[...held.keys()],other=e.pointerId===p?q:p,pin=held.get(other),grip=held.get(e.pointerId),now=time(e);if(Math.abs(now-pin)>1e-3&&(now-pin)*(grip-pin)>0){const k=(grip-pin)/(now-pin);show(pin-(pin-from)*k,pin+(to-pin)*k)}}});
 for(const end of["pointerup","pointercancel"])c.addEventListener(end,e=>held.delete(e.pointerId));
 c.addEventListener("pointerleave",()=>{tip.style.display="none"});
 c.addEventListener("dblclick",()=>show(0,whole));
}
const around=f=>{const m=(from+to)/2,h=(to-from)/2*f;show(m-h,m+h)};
document.getElementById("in").onclick=()=>around(.5);document.getElementById("out").onclick=()=>around(2);document.getElementById("all").onclick=()=>show(0,whole);
for(const b of document.querySelectorAll("button[data-from]"))b.onclick=()=>{const a=+b.dataset.from,z=+b.dataset.to,p=Math.max(2,.3*(z-a));show(a-p,z+p);document.getElementById("bar").scrollIntoView({behavior:"smooth"})};
addEventListener("resize",later);draw();
